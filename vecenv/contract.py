"""The verbs every vecenv environment speaks, and the values that travel through them.

Read this page first. An environment is a *batch* of ``B = num_envs`` slots; each slot holds one episode of one task.
``reset`` makes every slot live and returns metadata, ``step_*`` advances and returns control signals, ``observe_*``
reads without advancing, ``evaluate`` reports the verdict. All arrays are NumPy, the first axis is the slot, lengths are
metres, angles radians, poses are in the world frame, quaternions are wxyz.

Rules that hold for every environment:

* ``reset`` is an idempotent ensure-live: live slots are left alone, finished ones are re-armed in place. Which episode
  sits in a slot is decided by ``set_episodes``, never by ``reset``.
* ``observe_*`` never advances a slot; on a finished slot it reads the terminal state.
* ``terminated`` means success, ``truncated`` means the step budget ran out (or the slot was quarantined). A finished
  slot ignores further steps: reward 0, flags kept.
* What success means is an option. ``"first"``: an episode ends when its goal first holds. ``"final"``: it goes on to
  the end of its budget, and the verdict is read there. ``evaluate`` reports both. The reward is 1 at the tick at which
  the goal first holds, else 0.
* A chunk of K actions stops at a slot's own terminal step; the other slots go on.
* NaN and infinities in actions become 0 and values are clipped to the action range; ``info["sanitized"]`` says where.
* A slot whose physics fails (non-finite state, exhausted contact memory) is quarantined: ``info["fault"][i]`` names the
  cause, the slot ends truncated and unsuccessful, and no other slot is affected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Protocol, Self, TypeAlias, TypeVar, runtime_checkable

import numpy as np

from vecenv.errors import NotFound
from vecenv.placement import Placement

# Called before a tick: actions [B, 7], and which slots they are for, bool [B].
Watcher: TypeAlias = Callable[[np.ndarray, np.ndarray], None]
# When an episode that reaches its goal ends: there, or at the end of its budget.
FIRST, FINAL = SUCCESS_MODES = ("first", "final")
# Columns of the 7-vector taken by ``step_continuous``.
ACTION_DIM = 7
# Columns of the 8-vector taken by ``step_ee_pose``: x, y, z, qw, qx, qy, qz, grip (1 closed, 0 open).
EE_POSE_DIM = 8


@dataclass(frozen=True)
class ResetInfo:
    """What ``reset`` returns: episode metadata, no observation.

    Attributes:
        instruction: language instruction of each slot, length B.
        episode_id: ``"{suite}/{task}/{episode}"`` of each slot, length B; the task is its index in LIBERO, its name in
            SIMPLER.
        suite: suite name of the environment.
        task_id: task index of each slot, int [B].
        max_steps: step budget of each slot in control ticks, int [B].
    """

    instruction: tuple[str, ...]
    episode_id: tuple[str, ...]
    suite: str
    task_id: np.ndarray
    max_steps: np.ndarray


@dataclass(frozen=True)
class Control:
    """What every ``step_*`` returns: control signals, no observation.

    Attributes:
        reward: sum of the rewards over the ticks of this call, float64 [B].
        terminated: the task is solved, bool [B].
        truncated: the budget ran out or the slot was quarantined, bool [B].
        success: verdict of each slot at its last executed tick, bool [B].
        step_index: control ticks executed in the episode so far, int [B].
        info: diagnostics. Always has ``sanitized`` (bool [B], an action held NaN, infinities or values out of range),
            ``fault`` (tuple of B strings, empty when healthy) and ``ticks`` (int [B], ticks executed in this call);
            SIMPLER's also ``parts`` (what its success is made of, a mapping a slot) and ``stand_ins`` (sentences about
            missing files, a tuple a slot).
    """

    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    success: np.ndarray
    step_index: np.ndarray
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def done(self) -> np.ndarray:
        """Slots that are finished, bool [B]."""
        return self.terminated | self.truncated


@dataclass(frozen=True)
class EePoseControl(Control):
    """``step_ee_pose``'s return: control signals plus how the servo ended.

    Attributes:
        converged: position and rotation both within tolerance, bool [B].
        final_pose: end-effector pose when the call ended, xyz + wxyz, [B, 7].
        step_count: control ticks used by this call, int [B].
        error: why a slot did not move ("" when it did), B strings.
    """

    converged: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    final_pose: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    step_count: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    error: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlanControl(Control):
    """``step_waypoints``' return: control signals plus how the plan was followed.

    Attributes:
        converged: within tolerance when the waypoint was left, bool [B, T].
        waypoint_ticks: control ticks spent on each waypoint, int [B, T].
        final_pose: end-effector pose when the call ended, xyz + wxyz, [B, 7].
        error: which waypoints of a slot were left out and why ("" when none), B strings.
    """

    converged: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), bool))
    waypoint_ticks: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), int))
    final_pose: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    error: tuple[str, ...] = ()


class ImagesUnavailable(NotFound):
    """An image was asked of an observation that has none; the message says which and what is there."""


class UnknownCamera(ImagesUnavailable, KeyError):
    """A camera that does not exist; the message lists those that do."""


@dataclass(frozen=True)
class CameraView:
    """Where a camera of each slot is, and how it maps directions to pixels of the delivered image.

    Attributes:
        intrinsics: camera matrices [B, 3, 3]: ``intrinsics @ p`` is proportional to (x, y, 1) for a point p in the
            camera's frame; pixel centres are at whole numbers, x counts columns and y rows from the top left.
            LIBERO's x entry is negative: its delivered images are mirrored, as VLA training data are.
        pos: position in metres, world frame, [B, 3].
        mat: rotation to the world frame, [B, 3, 3]; columns are the camera's right, down and forward.
    """

    intrinsics: np.ndarray
    pos: np.ndarray
    mat: np.ndarray


_Shown = TypeVar("_Shown")
# Upstream's names of the two policy cameras and of their images.
_CAMERA_ALIASES: Mapping[str, str] = MappingProxyType(
    {
        "agentview_image": "agentview",
        "wrist_image": "wrist",
        "robot0_eye_in_hand": "wrist",
        "robot0_eye_in_hand_image": "wrist",
    }
)


class Rendered(Mapping[str, _Shown]):
    """Images (or anything else) by camera, each made when it is first read and kept.

    LIBERO's names work as well: ``images["agentview_image"]`` is ``images["agentview"]``, and
    ``images["robot0_eye_in_hand_image"]`` is ``images["wrist"]``. Another name raises ``UnknownCamera``.

    Args:
        names: the cameras.
        render: makes those of several cameras at once.
    """

    def __init__(self, names: Iterable[str], render: Callable[[Sequence[str]], Mapping[str, _Shown]]) -> None:
        self._names, self._render = tuple(names), render
        self._made: dict[str, _Shown] = {}

    def prepare(self, *names: str) -> None:
        """Make several in one go, which takes less time than one by one."""
        known = [self._canonical(name) for name in names if name in self]
        missing = [name for name in known if name not in self._made]
        if missing:
            self._made.update(self._render(missing))

    def __getitem__(self, name: str) -> _Shown:
        if name not in self:
            raise UnknownCamera(f"there is no camera {name!r}; cameras: {', '.join(self._names) or 'none'}")
        self.prepare(name)
        return self._made[self._canonical(name)]

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and self._canonical(name) in self._names

    def _canonical(self, name: str) -> str:
        return name if name in self._names else _CAMERA_ALIASES.get(name, name)

    def __repr__(self) -> str:
        return f"Rendered(cameras: {', '.join(self._names) or 'none'})"

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


@dataclass(frozen=True)
class Egocentric:
    """``observe_egocentric``'s return. Mappings are by camera and may render when they are first read.

    Attributes:
        state: proprioception, float32. LIBERO [B, 8]: end-effector position, axis-angle orientation, two finger
            positions. SIMPLER [B, 23] (WidowX) or [B, 29] (Google Robot): joint positions, joint velocities, pose of
            the base (xyz, wxyz).
        images: camera images, uint8 [B, H, W, 3]. LIBERO's are rotated by 180 degrees against upstream's observations,
            as VLA training data are; SIMPLER's are as upstream's. Empty when the environment does not render.
        depths: distances from the camera's plane, metres, float32 [B, H, W], pixel by pixel with ``images``.
        segmentations: index into ``instances[slot]`` of what each pixel shows, int16 [B, H, W]; likewise.
        views: where the cameras are.
        instances: what can be seen in each slot, B tuples of names; "" is everything that has none.
        pose: navigation pose; always None for manipulation.
    """

    state: np.ndarray
    images: Mapping[str, np.ndarray] = field(default_factory=dict)
    depths: Mapping[str, np.ndarray] = field(default_factory=dict)
    segmentations: Mapping[str, np.ndarray] = field(default_factory=dict)
    views: Mapping[str, CameraView] = field(default_factory=dict)
    instances: tuple[tuple[str, ...], ...] = ()
    pose: None = None

    @property
    def rgb(self) -> np.ndarray:
        """The third-person camera's image, [B, H, W, 3]; raises ``ImagesUnavailable`` where nothing renders."""
        return _camera(self.images, "agentview", "image")

    @property
    def agentview_image(self) -> np.ndarray:
        """LIBERO's name for ``rgb``."""
        return self.rgb

    @property
    def wrist_image(self) -> np.ndarray:
        """The wrist camera's image, [B, H, W, 3]; raises ``ImagesUnavailable`` where nothing renders.

        SIMPLER has no wrist camera: there it is None, and ``observation`` is the third-person image alone.
        """
        return _camera(self.images, "wrist", "image")

    @property
    def observation(self) -> list[np.ndarray]:
        """The two camera images in the order policies expect: third-person, wrist."""
        if isinstance(self.images, Rendered):
            self.images.prepare("agentview", "wrist")
        return [self.rgb, self.wrist_image]

    @property
    def depth(self) -> np.ndarray:
        """The third-person camera's depth, [B, H, W]; raises ``ImagesUnavailable`` where nothing renders."""
        return _camera(self.depths, "agentview", "depth image")

    @property
    def segmentation(self) -> np.ndarray:
        """The third-person camera's instances, [B, H, W]; raises ``ImagesUnavailable`` where nothing renders."""
        return _camera(self.segmentations, "agentview", "segmentation image")

    @property
    def intrinsics(self) -> np.ndarray | None:
        """The third-person camera's matrices, [B, 3, 3]; None where there are no cameras."""
        return self.views["agentview"].intrinsics if "agentview" in self.views else None

    def points_from_pixels(self, camera: str, xy: np.ndarray) -> np.ndarray:
        """World points that pixels show, metres, float64 [B, N, 3].

        Args:
            camera: a camera's name.
            xy: columns and rows in the delivered image, int [N, 2] for all slots or [B, N, 2].

        Raises:
            ImagesUnavailable: there is no such camera.
            IndexError: a pixel outside the image.
        """
        depth, view = _camera(self.depths, camera, "depth image"), _camera(self.views, camera, "view")
        batch, height, width = depth.shape
        pixels = np.asarray(xy)
        pixels = np.broadcast_to(pixels, (batch, *pixels.shape[-2:]))
        x, y = pixels[..., 0].astype(int), pixels[..., 1].astype(int)
        if ((x < 0) | (x >= width) | (y < 0) | (y >= height)).any():
            raise IndexError(f"a pixel lies outside the image of {width} x {height}")
        rays = np.stack([pixels[..., 0], pixels[..., 1], np.ones(x.shape)], axis=-1)
        rays = rays @ np.linalg.inv(view.intrinsics).transpose(0, 2, 1)
        points = rays * depth[np.arange(batch)[:, None], y, x, None]
        return points @ view.mat.transpose(0, 2, 1) + view.pos[:, None]


def _camera(found: Mapping[str, _Shown], name: str, what: str) -> _Shown:
    if name not in found:
        there = f"there are: {', '.join(found)}" if found else "this environment renders nothing; `state` is there"
        raise ImagesUnavailable(f"no {what} of camera {name!r}: {there}")
    return found[name]


@dataclass(frozen=True)
class PointCloud:
    """Surface samples of one named thing: ``points`` [N, 3] and outward unit ``normals`` [N, 3], world frame."""

    points: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True)
class RegionBox:
    """A named place: a box with centre ``pos`` [3], rotation ``mat`` [3, 3] and ``half_extents`` [3], in metres.

    ``parent`` is the object or fixture it belongs to, None for a place on the table or floor. ``axis`` is the axis
    along which the part that carries it slides (a drawer's, unit vector [3]), None where nothing slides. World frame.
    """

    pos: np.ndarray
    mat: np.ndarray
    half_extents: np.ndarray
    parent: str | None = None
    axis: np.ndarray | None = None


@dataclass(frozen=True)
class PartJoint:
    """The joint that moves a part.

    Attributes:
        kind: ``"slide"`` or ``"hinge"``.
        axis: direction in which the part slides to open; or the axis about which it turns, counterclockwise seen from
            its tip, to open or switch on. Unit vector, world frame, [3].
        anchor: a point on the axis, world frame, [3].
        travel: how far it opens, metres or radians.
        opened: how far it is open now, likewise; 0 is closed or off.
    """

    kind: str
    axis: np.ndarray
    anchor: np.ndarray
    travel: float
    opened: float


@dataclass(frozen=True)
class Part:
    """A part of an object or fixture that can be named: a drawer, a handle, a door, a knob, a top, a space.

    Attributes:
        parent: the thing it belongs to.
        kind: ``"drawer"``, ``"door"``, ``"handle"``, ``"knob"``, ``"top"`` (things stand on it) or ``"space"``
            (things go into it).
        cloud: surface samples.
        box: the region it is, or that moves with it; None without.
        joint: what moves it; None where nothing does.
    """

    parent: str
    kind: str
    cloud: PointCloud
    box: RegionBox | None = None
    joint: PartJoint | None = None


@dataclass(frozen=True)
class ObjectsSnapshot:
    """Ground truth of one slot, as planners read it.

    Attributes:
        names: names of the movable objects, then of the fixtures, in the task's own vocabulary.
        objects: name -> surface samples of its collision geometry.
        poses: name -> pose of its origin, xyz + wxyz, [7]; goals are stated about origins.
        regions: name -> box, the places goals speak of.
        goal: the task's predicates, e.g. ``("on", "bowl_1", "plate_1")``; all must hold.
        scene: surface samples of everything that collides, the robot excluded.
        ee_pose: end-effector pose, xyz + wxyz, [7].
        gripper: the two finger positions in metres, [2].
        workspace: lower and upper corner of the workspace, [2, 3].
        targets: names the task is about (``obj_of_interest``).
        movable: the names that are not fixed to the world.
        parts: name -> part of one of them; LIBERO's are named as ``vecenv.libero.scene.parts`` says.
    """

    names: tuple[str, ...]
    objects: dict[str, PointCloud]
    poses: dict[str, np.ndarray]
    regions: dict[str, RegionBox]
    goal: tuple[tuple[str, ...], ...]
    scene: PointCloud
    ee_pose: np.ndarray
    gripper: np.ndarray
    workspace: np.ndarray
    targets: tuple[str, ...] = ()
    movable: tuple[str, ...] = ()
    parts: Mapping[str, Part] = field(default_factory=dict)


@dataclass(frozen=True)
class Objects:
    """``observe_objects``'s return: one snapshot a slot, and why one is missing.

    Attributes:
        snapshot: B snapshots; None where ``error`` says why.
        error: B strings, empty when the snapshot is there.
    """

    snapshot: tuple[ObjectsSnapshot | None, ...]
    error: tuple[str, ...]


@dataclass(frozen=True)
class Metrics:
    """``evaluate``'s return: the verdict of each slot as of its last executed tick.

    Attributes:
        success: bool [B].
        num_steps: control ticks executed, int [B].
        suite: suite name.
        task_id: int [B].
        cumulative_reward: sum of rewards since the episode began, float64 [B].
        success_first: the goal held after one of the ticks, bool [B].
        success_final: the goal held after the last executed tick, bool [B]; ``success`` is this.
    """

    success: np.ndarray
    num_steps: np.ndarray
    suite: str
    task_id: np.ndarray
    cumulative_reward: np.ndarray
    success_first: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    success_final: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    def __post_init__(self) -> None:
        # Where episodes end at success, the two are one.
        for name in ("success_first", "success_final"):
            if len(getattr(self, name)) != len(self.success):
                object.__setattr__(self, name, self.success.copy())


@dataclass(frozen=True)
class Timings:
    """Where an environment's time went since it was made, seconds of wall clock.

    Attributes:
        physics_s: stepping and resetting.
        images_s: rendering images.
    """

    physics_s: float = 0.0
    images_s: float = 0.0


@dataclass(frozen=True)
class State:
    """Physics state of every slot.

    Scenes differ in size, so rows are padded with zeros up to the widest scene of the batch; ``nq[i]`` and ``nv[i]``
    say how much of row i is real.

    Attributes:
        qpos: [B, max nq].
        qvel: [B, max nv].
        time: simulated seconds, [B].
        nq: int [B].
        nv: int [B].
    """

    qpos: np.ndarray
    qvel: np.ndarray
    time: np.ndarray
    nq: np.ndarray
    nv: np.ndarray


@runtime_checkable
class BatchEnv(Protocol):
    """The verbs. ``vecenv.make`` returns one of these whatever the simulator underneath."""

    suite: str
    num_envs: int

    @property
    def config(self) -> object:
        """The options it was made with, those that the protocol decided filled in: the family's config."""
        ...

    @property
    def control_hz(self) -> float:
        """Control ticks a second."""
        ...

    @property
    def placement(self) -> Placement:
        """Task and episode of each slot."""
        ...

    @property
    def done(self) -> np.ndarray:
        """Which slots have finished their episode, bool [B]; the others are live, or wait for ``reset``."""
        ...

    @property
    def timings(self) -> Timings:
        """Seconds spent so far in physics and in rendering images."""
        ...

    def instructions(self) -> tuple[str, ...]:
        """What each slot's policy is told at present; some SIMPLER tasks have two instructions in turn."""
        ...

    def reset(self) -> ResetInfo:
        """Make every slot live; live slots are left alone."""
        ...

    def step_continuous(self, actions: Any) -> Control:
        """Advance by one tick, [B, 7], or a chunk, [B, K, 7]."""
        ...

    def step_ee_pose(self, poses: Any, hold_steps: Any = 0) -> EePoseControl:
        """Drive the end effectors to absolute poses, [B, 8]."""
        ...

    def step_waypoints(self, plan: Any, max_misses: int | None = None) -> PlanControl:
        """Follow a plan, waypoints [B, T]."""
        ...

    def observe_egocentric(self, slots: Any = None) -> Egocentric:
        """Cameras and proprioception; images of some slots only, where ``slots`` says which."""
        ...

    def observe_objects(self, points: str = "surface", slots: Any = None) -> Objects:
        """Ground truth; of some slots only, where ``slots`` says which."""
        ...

    def evaluate(self) -> Metrics:
        """Verdicts."""
        ...

    def state(self) -> State:
        """Physics state of every slot, a copy."""
        ...

    def set_state(self, state: State) -> None:
        """Overwrite the physics state of every slot; step counts and verdicts stay."""
        ...

    def watched(self, watcher: Watcher) -> AbstractContextManager[None]:
        """While inside, ``watcher`` is called before every tick of an episode."""
        ...

    def set_episodes(self, *, tasks: Any = None, episodes: Any = None, slots: Any = None) -> None:
        """Choose what each slot runs next, or some slots while the others continue; then call ``reset``."""
        ...

    def close(self) -> None:
        """Release the simulator, once, at the end."""
        ...

    def __enter__(self) -> Self:
        """``with vecenv.make(...) as env``: the environment is closed at the end of the block."""
        ...

    def __exit__(self, *_: object) -> None:
        """Close."""
        ...
