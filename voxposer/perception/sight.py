"""Where the observations of a batch come from: ground truth, or the depth images of cameras.

The agent asks a :class:`Sight` for a snapshot of some slots once a round. :class:`GroundTruth` passes on what
``observe_objects`` returns; :class:`CameraSight` reads ``observe_egocentric`` alone (images, camera poses,
proprioception) and builds snapshots of the same type from what is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.spatial.transform import Rotation

from vecenv.contract import BatchEnv
from vecenv.observations import Egocentric, ImagesUnavailable, Objects, ObjectsSnapshot
from voxposer.perception.cameras import depth_views
from voxposer.perception.config import CAMERAS, PerceptionConfig
from voxposer.perception.seen import ROBOT, NotSeen, Proprioception, SceneMemory
from voxposer.perception.segments import Segmenter, make_segmenter


@runtime_checkable
class HandReporting(Protocol):
    """An environment that says itself where its hand is, because its proprioception has other columns than LIBERO's."""

    def hand_state(self, seen: Egocentric) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the hands, xyz + wxyz, [B, 7], and the two finger positions of each, metres, [B, 2]."""
        ...


class Sight(Protocol):
    """The source of observations."""

    @property
    def title(self) -> str:
        """What it is, in words, for results."""
        ...

    def unseen(self, slot: int) -> str:
        """Which objects of a slot the latest look did not find, in a sentence; "" for none."""
        ...

    def look(self, slots: Sequence[int], closed: Sequence[bool]) -> Objects:
        """Snapshots of some slots; None, with a reason, where there is none.

        Args:
            slots: which.
            closed: of every slot of the batch, whether its hand was last told to close.
        """
        ...

    def begin(self, slots: Sequence[int]) -> np.ndarray:
        """Forget what these slots saw, because an episode begins in each.

        Returns:
            Poses of the hands of all slots, xyz + wxyz, [B, 7].
        """
        ...


class GroundTruth:
    """What the simulator says.

    Args:
        env: the batch.
    """

    def __init__(self, env: BatchEnv) -> None:
        self._env = env

    @property
    def title(self) -> str:
        """What it is, in words."""
        return PerceptionConfig().title

    def unseen(self, slot: int) -> str:
        """Nothing: the simulator knows all."""
        del slot
        return ""

    def look(self, slots: Sequence[int], closed: Sequence[bool]) -> Objects:
        """The simulator's snapshots."""
        del closed
        return self._env.observe_objects(slots=list(slots))

    def begin(self, slots: Sequence[int]) -> np.ndarray:
        """Poses of the hands; those of other slots are zero."""
        poses = np.zeros((self._env.num_envs, 7))
        for i, snapshot in enumerate(self._env.observe_objects(slots=list(slots)).snapshot):
            if snapshot is not None:
                poses[i] = snapshot.ee_pose
        return poses


class CameraSight:
    """What cameras see.

    Args:
        env: the batch; nothing but its ``observe_egocentric`` is read.
        config: options.
    """

    def __init__(self, env: BatchEnv, config: PerceptionConfig) -> None:
        self._env, self._config = env, config
        self._cameras = config.camera.cameras
        self._memory: dict[int, SceneMemory] = {}
        self._unseen: dict[int, tuple[str, ...]] = {}
        self._segmenter: Segmenter = make_segmenter(config.camera)

    def hands(self) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the hands, xyz + wxyz, [B, 7], and their finger positions, metres, [B, 2], by proprioception."""
        return _proprioception(self._env, self._env.observe_egocentric(slots=[]))

    @property
    def title(self) -> str:
        """What it is, in words, with the cameras once they are known."""
        return ", ".join([self._config.title, *([" and ".join(self._cameras)] if self._cameras else [])])

    def begin(self, slots: Sequence[int]) -> np.ndarray:
        """Forget these slots; the poses of the hands are from proprioception."""
        poses, _ = self.hands()
        for i in slots:
            self._unseen.pop(i, None)
            base = poses[i, :2] - [self._config.home_reach, 0.0]
            self._memory[i] = SceneMemory(self._config, base)
        return poses

    def unseen(self, slot: int) -> str:
        """Which objects the cameras did not show, and could not be remembered, in a sentence."""
        names = self._unseen.get(slot, ())
        how = "by geometry" if self._config.camera.segmentation == "geometry" else "by the cameras"
        return f"not found {how}: {', '.join(names)}" if names else ""

    def look(self, slots: Sequence[int], closed: Sequence[bool]) -> Objects:
        """Snapshots of what is seen and remembered.

        Raises:
            ImagesUnavailable: the environment does not have one of the cameras; the message says which it has.
        """
        camera = self._config.camera
        snapshots: list[ObjectsSnapshot | None] = [None] * self._env.num_envs
        errors = [""] * self._env.num_envs
        if not slots:
            return Objects(tuple(snapshots), tuple(errors))
        seen = self._env.observe_egocentric(slots=list(slots))
        if self._cameras is None:
            self._cameras = tuple(name for name in CAMERAS if name in seen.depths) or CAMERAS[:1]
        missing = [name for name in self._cameras if name not in seen.depths]
        if missing:
            there = ", ".join(seen.depths) or "none"
            raise ImagesUnavailable(f"perception from cameras needs {', '.join(missing)}; there are: {there}")
        masks = camera.segmentation == "renderer"
        colors = camera.colored or not masks
        views = depth_views(seen, self._cameras, slots, masks=masks, colors=colors, largest=camera.largest_image)
        poses, grippers = _proprioception(self._env, seen)
        for i, own in zip(slots, views, strict=True):
            robot = Proprioception(poses[i], grippers[i], closed[i])
            try:
                memory = self._memory[i]
                labelled = self._segmenter.label(own, seen.instances[i], memory, robot)
                snapshots[i] = found = memory.look(labelled, robot)
                self._unseen[i] = tuple(name for name in seen.instances[i] if name not in ("", ROBOT, *found.names))
            except NotSeen as error:
                errors[i] = str(error)
        return Objects(tuple(snapshots), tuple(errors))


def make_sight(env: BatchEnv, config: PerceptionConfig) -> Sight:
    """The source of observations that a config names."""
    return CameraSight(env, config) if config.source == "camera" else GroundTruth(env)


def _proprioception(env: BatchEnv, seen: Egocentric) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the hands, [B, 7], and finger positions, [B, 2], by the robots' own state."""
    if isinstance(env, HandReporting):
        return env.hand_state(seen)
    state = np.asarray(seen.state, float)
    quats = Rotation.from_rotvec(state[:, 3:6]).as_quat(scalar_first=True)
    return np.concatenate([state[:, :3], quats], axis=1), state[:, 6:8]
