"""What Gymnasium's observations of a batch consist of: images, proprioception, and poses of objects.

In: a batch and the names of what is observed. Out: the space of one slot's observation and, at each call, arrays with
the slot as first axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from gymnasium import spaces

import vecenv
from vecenv.errors import InvalidInput
from vecenv.libero.env import LiberoEnv
from vecenv.libero.physics.base import Group
from vecenv.libero.render.options import POLICY_CAMERAS
from vecenv.libero.scene.scene import Scene
from vecenv.observations import Egocentric, Rendered, choose_cameras

if TYPE_CHECKING:
    from vecenv.simpler.env import SimplerEnv

Batch: TypeAlias = "LiberoEnv | SimplerEnv"
Observation: TypeAlias = "np.ndarray | dict[str, np.ndarray]"

OBSERVATIONS = ("pixels", "state", "proprio", "objects")
"""What can be observed: camera images, proprioception (under either name), and poses of all objects and fixtures."""
# Observations are clipped to plus and minus this (metres, radians): a bound that only broken physics reaches.
BOUND = 100.0


class GymnasiumError(InvalidInput):
    """An option that these environments do not have; the message says what would be right."""


class Observer:
    """What is observed of a batch.

    Args:
        env: the batch.
        obs: one of ``OBSERVATIONS`` or several joined by ``+`` (``"pixels+state"``), or a sequence of them; None for
            proprioception and, in LIBERO, poses of objects. One name other than ``"pixels"`` gives a plain array,
            everything else a dictionary, in which ``"pixels"`` is one entry for each camera.
        cameras: whose images; None for the two that policies are trained on, as far as they exist.

    Raises:
        GymnasiumError: an observation or camera that does not exist.

    Attributes:
        space: of one slot.
        cameras: the cameras it observes or renders from, the first of them first.
        layouts: where what is in ``objects``, for each slot: name -> columns; empty mappings without objects.
    """

    def __init__(self, env: Batch, obs: str | Sequence[str] | None, cameras: Sequence[str] | None = None) -> None:
        self._env = env
        names = _names(env, obs)
        self._plain = isinstance(obs, str) and len(names) == 1 and names[0] != "pixels"
        self._names = names
        self._shapes = _image_shapes(env)
        self.cameras = _cameras(self._shapes, cameras)
        self._width, self.layouts = _object_layouts(env) if "objects" in names else (0, ({},) * env.num_envs)
        boxes: dict[str, spaces.Space] = {}
        for name in names:
            boxes |= self._boxes(name)
        self.space: spaces.Space[Any] = self._box(names[0]) if self._plain else spaces.Dict(boxes)

    def __call__(self) -> Observation:
        """The present observation of every slot."""
        seen = self._env.observe_egocentric()
        found: dict[str, np.ndarray] = {}
        for name in self._names:
            if name == "pixels":
                found |= self.images(seen)
            else:
                found[name] = _bounded(self._objects() if name == "objects" else seen.state)
        return found[self._names[0]] if self._plain else found

    def images(self, seen: Egocentric | None = None) -> dict[str, np.ndarray]:
        """What the cameras see, uint8 [B, H, W, 3] by camera."""
        images = (seen or self._env.observe_egocentric()).images
        if isinstance(images, Rendered):
            images.prepare(*self.cameras)
        return {camera: images[camera] for camera in self.cameras}

    def frames(self) -> tuple[np.ndarray, ...]:
        """The first camera's image of each slot, uint8 [H, W, 3]: what ``render`` shows."""
        return tuple(self._env.observe_egocentric().images[self.cameras[0]])

    def _boxes(self, name: str) -> dict[str, spaces.Space]:
        if name != "pixels":
            return {name: self._box(name)}
        return {camera: spaces.Box(0, 255, (*self._shapes[camera], 3), np.uint8) for camera in self.cameras}

    def _box(self, name: str) -> spaces.Box:
        width = self._width if name == "objects" else _state_width(self._env)
        return spaces.Box(-BOUND, BOUND, (width,), np.float32)

    def _objects(self) -> np.ndarray:
        assert isinstance(self._env, LiberoEnv)
        out = np.zeros((self._env.num_envs, self._width))
        for group in self._env.physics.groups:
            with group.refreshed():
                seen = _object_poses(group)
            out[group.slots, : seen.shape[1]] = seen
        return out


def _names(env: Batch, obs: str | Sequence[str] | None) -> tuple[str, ...]:
    possible = OBSERVATIONS if isinstance(env, LiberoEnv) else OBSERVATIONS[:-1]
    if obs is None:
        return possible[2:]
    names = tuple(obs.split("+")) if isinstance(obs, str) else tuple(obs)
    if not names or len(set(names)) != len(names) or not set(names) <= set(possible):
        raise GymnasiumError(
            f"obs={obs!r}: {env.suite} has {', '.join(possible)}; join several with '+', for example 'pixels+state'"
        )
    return names


def _cameras(shapes: Mapping[str, tuple[int, int]], chosen: Sequence[str] | None) -> tuple[str, ...]:
    if chosen is None:
        return tuple(camera for camera in POLICY_CAMERAS if camera in shapes) or tuple(shapes)
    cameras = (chosen,) if isinstance(chosen, str) else tuple(chosen)
    unknown = [camera for camera in cameras if camera not in shapes]
    if unknown or not cameras:
        raise GymnasiumError(f"cameras={chosen!r}: expected some of {', '.join(shapes)}")
    return cameras


def _image_shapes(env: Batch) -> dict[str, tuple[int, int]]:
    """Height and width of each camera's images."""
    if isinstance(env, LiberoEnv):
        render = vecenv.RenderConfig() if env.config.render is None else env.config.render
        assert isinstance(render, vecenv.RenderConfig)
        in_scene = [{model.camera(index).name for index in range(model.ncam)} for model in env.mj_models]
        names = (*POLICY_CAMERAS, *(camera.name for camera in render.cameras), *sorted(set.intersection(*in_scene)))
        if env.config.cameras is not None:
            names = choose_cameras(env.config.cameras, names)
        return dict.fromkeys(names, (render.height, render.width))
    camera = env.tasks[int(env.placement.task[0])].camera
    return {POLICY_CAMERAS[0]: (camera.height, camera.width)}


def _state_width(env: Batch) -> int:
    """Columns of ``observe_egocentric().state``; SIMPLER's are positions, velocities and the pose of the base."""
    return 8 if isinstance(env, LiberoEnv) else 2 * env.robot.dof + 7


def _bounded(values: np.ndarray) -> np.ndarray:
    return np.clip(np.nan_to_num(values), -BOUND, BOUND).astype(np.float32)


def _object_layouts(env: Batch) -> tuple[int, tuple[Mapping[str, slice], ...]]:
    assert isinstance(env, LiberoEnv)
    layouts = [_layout(group.scene) for group in env.physics.groups]
    width = max(max(columns.stop for columns in layout.values()) for layout in layouts)
    return width, tuple(layouts[group] for group in env.scene_index)


def _layout(scene: Scene) -> Mapping[str, slice]:
    columns = {name: slice(7 * i, 7 * i + 7) for i, name in enumerate(scene.entities)}
    poses = 7 * len(columns)
    return {**columns, "fixture_joints": slice(poses, poses + sum(len(entity.joints) for entity in scene.fixtures))}


def _object_poses(group: Group) -> np.ndarray:
    """Poses of all objects and fixtures and joint positions of the fixtures, [n, width]."""
    scene, rows = group.scene, len(group.slots)
    bodies = [scene.model.body(entity.root_body).id for entity in scene.entities.values()]
    joints = [scene.model.joint(joint).qposadr[0] for entity in scene.fixtures for joint in entity.joints]
    poses = np.concatenate([group.xpos[:, bodies], group.xquat[:, bodies]], axis=2)
    return np.concatenate([poses.reshape(rows, -1), group.qpos[:, np.array(joints, int)]], axis=1)
