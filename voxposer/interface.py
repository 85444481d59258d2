"""The functions that language programs call: they read one frozen snapshot and ask for motions.

A :class:`~voxposer.perception.view.Perception` comes in with each subtask (:meth:`Interface.begin`). The motions that
programs ask for are collected as :class:`~voxposer.requests.MotionRequest` s, in order; those of one subtask are
executed one after the other. ``voxposer.agent`` plans and executes them, so no program moves a robot itself. Names,
arguments and defaults are upstream's (huangwl18/VoxPoser, ``interfaces.py``), with a few additions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from vecenv.manipulation.world import matrix
from vecenv.observations import ObjectsSnapshot
from voxposer.arguments import finite_in_single, number, numbers, plain_array, shown, text
from voxposer.language.observations import Observation
from voxposer.perception.observation import LazyObservation
from voxposer.perception.view import HAND_ALIASES, Perception
from voxposer.quaternions import euler2quat, pointat2quat, qinverse, qmult, quat2euler, quaternion, unit
from voxposer.requests import InterfaceError, MotionRequest
from voxposer.sandbox.guard import Kept, Record, RecordList

T = TypeVar("T")
# Motions that the programs of one subtask may ask for.
MOST_MOTIONS = 50
# What programs give to ``execute``: a value, or a function that computes it from the present state.
Observed = Observation | Callable[[], Observation]
VoxelMap = npt.ArrayLike | Callable[[], npt.ArrayLike]


class Interface:
    """The functions of one slot's programs.

    Attributes:
        requests: motions that were asked for in this subtask so far.
    """

    def __init__(self) -> None:
        self._perception: Perception | None = None
        self._closed = False
        self.requests: list[MotionRequest] = []

    def begin(self, perception: Perception) -> None:
        """Start a subtask with a fresh snapshot and no motions."""
        self._perception, self._closed = perception, perception.hand.closed
        self.requests = []

    def restart(self) -> None:
        """Forget what was asked for since the snapshot came: the program that asked is replaced."""
        ee = self.perception.snapshot.ee_pose
        self.perception.move_hand(ee[:3], matrix(ee[3:]), closed=self.perception.hand.closed)
        self._closed = self.perception.hand.closed
        self.requests = []

    def taken(self) -> list[MotionRequest]:
        """The motions asked for since the last call; their maps, which are large, are released here."""
        requests, self.requests = self.requests, []
        return requests

    def end(self) -> None:
        """Release the snapshot and the maps."""
        self._perception, self.requests = None, []

    @property
    def perception(self) -> Perception:
        """The view of the present snapshot."""
        if self._perception is None:
            raise InterfaceError("no snapshot yet: call begin() first")
        return self._perception

    @property
    def snapshot(self) -> ObjectsSnapshot | None:
        """The present snapshot; None without."""
        return None if self._perception is None else self._perception.snapshot

    def functions(self) -> dict[str, Callable[..., Any]]:
        """Every function that programs may call, by name."""
        named = (self.detect, self.reset_to_default_pose, self.get_ee_pos, self.cm2index, self.index2cm)
        empty = {
            f"get_empty_{kind}_map": getattr(self, f"_empty_{kind}")
            for kind in ("affordance", "avoidance", "rotation", "velocity", "gripper")
        }
        turning = {"pointat2quat": pointat2quat, "vec2quat": pointat2quat, "euler2quat": euler2quat}
        turning |= {"quat2euler": quat2euler, "qmult": qmult, "qinverse": qinverse}
        turning |= {"normalize_vector": normalize_vector, "normalize_map": normalize_map}
        others = {"execute": self._execute_kept, "set_voxel_by_radius": self.set_voxel_by_radius}
        return {**{f.__name__: f for f in named}, **others, **empty, **turning}

    # -- looking -------------------------------------------------------------------------------------------------------

    def detect(self, name: str) -> LazyObservation:
        """Observation of an object, a part, or one of the aliases of hand and table."""
        return self.perception.detect(text(name, "name"))

    def get_ee_pos(self) -> np.ndarray:
        """Voxel of the hand, int [3]."""
        return self.perception.grid.voxel(self.perception.ee.pos)

    def cm2index(self, cm: float, direction: npt.ArrayLike) -> Any:
        """Centimetres as voxels along ``"x"``, ``"y"``, ``"z"`` (int), or along a vector [3] (int [3])."""
        size = self.perception.grid.resolution * 100
        cm = number(cm, "cm")
        if isinstance(direction, str):
            return int(cm / size[_axis(direction)])
        return (cm * unit(numbers(direction, "direction", (3,))) / size).astype(int)

    def index2cm(self, index: float, direction: str | None = None) -> float:
        """Voxels as centimetres along an axis, or along the average axis."""
        size = self.perception.grid.resolution * 100
        index = number(index, "index")
        return index * float(size.mean() if direction is None else size[_axis(direction)])

    # -- maps ----------------------------------------------------------------------------------------------------------

    def set_voxel_by_radius(
        self, voxel_map: np.ndarray, voxel_xyz: npt.ArrayLike, radius_cm: float = 0, value: npt.ArrayLike = 1
    ) -> np.ndarray:
        """Set the voxels within a box of half edge ``radius_cm`` around a voxel (upstream's, for a ball)."""
        size = self.perception.grid.size
        if not isinstance(voxel_map, np.ndarray) or voxel_map.shape not in (self._shape, (*self._shape, 4)):
            raise InterfaceError(
                f"voxel_map: expected a map {[*self._shape]} or {[*self._shape, 4]}, got {shown(voxel_map)}"
            )
        shapes: tuple[tuple[int, ...], ...] = ((),) if voxel_map.ndim == 3 else ((), (4,))
        content = numbers(value, "value", *shapes)
        centre = np.clip(np.round(numbers(voxel_xyz, "voxel_xyz", (3,))), 0, size - 1).astype(int)
        reach = np.array([self.cm2index(max(number(radius_cm, "radius_cm"), 0), axis) for axis in "xyz"])
        low, high = np.maximum(centre - reach, 0), np.minimum(centre + reach + 1, size)
        voxel_map[low[0] : high[0], low[1] : high[1], low[2] : high[2]] = content
        return voxel_map

    def _empty_affordance(self) -> np.ndarray:
        return self._filled(0.0)

    def _empty_avoidance(self) -> np.ndarray:
        return self._filled(0.0)

    def _empty_velocity(self) -> np.ndarray:
        return self._filled(1.0)

    def _empty_gripper(self) -> np.ndarray:
        return self._filled(0.0 if self._closed else 1.0)

    def _empty_rotation(self) -> np.ndarray:
        now = quaternion(self.perception.ee.rotation)
        return np.array(np.broadcast_to(now, (*self._shape, 4)))

    def _filled(self, value: float) -> np.ndarray:
        return np.full(self._shape, value)

    @property
    def _shape(self) -> tuple[int, int, int]:
        size = self.perception.grid.size
        return size, size, size

    # -- asking for motions --------------------------------------------------------------------------------------------

    def execute(
        self,
        movable: Observed,
        affordance_map: VoxelMap | None = None,
        avoidance_map: VoxelMap | None = None,
        rotation_map: VoxelMap | None = None,
        velocity_map: VoxelMap | None = None,
        gripper_map: VoxelMap | None = None,
    ) -> None:
        """Ask for a motion of ``movable`` over maps; a map that is not given stays at the present state.

        Args:
            movable: what ``detect`` or ``parse_query_obj`` gave: the hand, an object, or a part on a joint.
            affordance_map: 1 at targets, [N, N, N]; without it the hand stays where it is.
            avoidance_map: 0 (free) to 1, [N, N, N].
            rotation_map: wxyz, world frame, [N, N, N, 4].
            velocity_map: 1 is full speed, nothing below 0, [N, N, N].
            gripper_map: 1 open, 0 closed, [N, N, N].

        Raises:
            InterfaceError: something else as ``movable``, a map of another shape or with values beyond single
                precision, an affordance map without targets, an object to push without one, or one that is fixed;
                more motions than a subtask may have.
        """
        self._require_few()
        seen = _seen(movable)
        name = str(seen["name"])
        object_centric = name.lower() not in HAND_ALIASES
        targets = None if affordance_map is None else self._targets(affordance_map)
        if object_centric:
            self._require_pushable(name, targets)
        request = MotionRequest(
            kind="stay" if targets is None else "path",
            movable=name,
            object_centric=object_centric,
            start=np.asarray(seen["position"], int),
            targets=targets,
            avoidance=None if avoidance_map is None else self._avoidance(avoidance_map),
            occupancy=np.asarray(seen["occupancy_map"]) > 0.5 if object_centric else None,
            rotation=self._rotation(rotation_map),
            velocity=self._velocity(velocity_map),
            gripper=self._gripper(gripper_map),
        )
        self.requests.append(request)
        if not object_centric:
            self._advance_hand(request)

    def _execute_kept(self, *arguments: Any, **named: Any) -> Kept:
        """``execute`` for programs, which have to pay for the memory of its maps."""
        self.execute(*arguments, **named)
        return Kept(self.requests[-1].nbytes)

    def _require_few(self) -> None:
        if len(self.requests) >= MOST_MOTIONS:
            raise InterfaceError(f"more than {MOST_MOTIONS} motions in one subtask")

    def reset_to_default_pose(self) -> None:
        """Ask for the hand to go where it was when the episode began, the grip as it is."""
        self._require_few()
        home = self.perception.hand.home
        voxel = self.perception.grid.voxel(home[:3])
        grip = np.asarray(0.0 if self._closed else 1.0)
        self.requests.append(
            MotionRequest("home", "gripper", False, voxel, None, None, None, home[3:].copy(), np.asarray(1.0), grip)
        )
        self.perception.move_hand(home[:3], matrix(home[3:]))

    def _advance_hand(self, request: MotionRequest) -> None:
        """Take the hand to be at the end of a motion, at the nearest target."""
        here = self.perception.grid.voxel(self.perception.ee.pos)
        end, pos = here, self.perception.ee.pos
        if request.targets is not None:
            found = np.argwhere(request.targets)
            end = found[int(np.linalg.norm(found - here, axis=1).argmin())]
            pos = self.perception.position_of(end)
        self.perception.move_hand(pos, matrix(request.rotation_at(end)))
        self._closed = request.closed_at_end(end)

    def _targets(self, given: VoxelMap) -> np.ndarray:
        targets = self._map(given, "affordance map") >= 0.999
        if not targets.any():
            raise InterfaceError("the affordance map has no target: no voxel is 1")
        return targets

    def _require_pushable(self, name: str, targets: np.ndarray | None) -> None:
        if targets is None:
            raise InterfaceError(f"{name} is to move, but there is no affordance map with its target")
        part = self.perception.snapshot.parts.get(name)
        if part is not None and part.joint is not None:
            if part.kind == "knob":
                raise InterfaceError(f"{name} cannot be pushed: it is turned, so grasp it and turn the hand")
        elif name not in self.perception.snapshot.movable:
            raise InterfaceError(f"{name} cannot be pushed: it is fixed")

    def _map(self, given: VoxelMap, what: str, *tail: int) -> np.ndarray:
        now = _now(given)
        if isinstance(now, (Record, RecordList)):
            raise InterfaceError(f"the {what} is an observation; expected a map {(*self._shape, *tail)}")
        value = plain_array(now, f"the {what}")
        if value.shape != (*self._shape, *tail):
            raise InterfaceError(f"the {what} has shape {value.shape}; expected {(*self._shape, *tail)}")
        if not finite_in_single(value):
            raise InterfaceError(f"the {what} holds values that are not finite in single precision")
        return value

    def _avoidance(self, given: VoxelMap) -> np.ndarray | None:
        value = np.clip(self._map(given, "avoidance map"), 0, 1).astype(np.float32)
        return value if value.any() else None

    def _rotation(self, given: VoxelMap | None) -> np.ndarray:
        if given is None:
            return quaternion(self.perception.ee.rotation)
        return _folded(self._map(given, "rotation map", 4), tail=1)

    def _velocity(self, given: VoxelMap | None) -> np.ndarray:
        value = np.asarray(1.0) if given is None else self._map(given, "velocity map")
        if (value < 0).any():
            raise InterfaceError("the velocity map holds values below 0")
        return _folded(value)

    def _gripper(self, given: VoxelMap | None) -> np.ndarray:
        if given is None:
            return np.asarray(0.0 if self._closed else 1.0)
        return _folded(self._map(given, "gripper map"))


def _now(value: T | Callable[[], T]) -> T:
    """The value, or what it evaluates to now."""
    return cast(T, value() if callable(value) else value)


def _seen(movable: Observed) -> Observation:
    """The observation of what is to be moved."""
    seen = _now(movable)
    if isinstance(seen, Observation):
        return seen
    if isinstance(seen, Sequence) and not isinstance(seen, str):
        raise InterfaceError(f"movable: {len(seen)} things; call execute for each of them")
    raise InterfaceError(f"movable: expected an observation from parse_query_obj or detect, got {shown(seen)}")


def normalize_vector(x: npt.ArrayLike) -> np.ndarray:
    """A vector [3], or rows of vectors [N, 3], scaled to length 1; zero for one shorter than 1e-6."""
    vectors = numbers(x, "normalize_vector", (3,), (None, 3))
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-6, vectors / np.maximum(length, 1e-6), 0.0)


def normalize_map(map: npt.ArrayLike) -> np.ndarray:
    """A map scaled to 0..1; as it is where all its values are equal."""
    values = numbers(map, "normalize_map")
    if not values.size:
        raise InterfaceError("normalize_map: expected numbers, got none")
    low, high = float(values.min()), float(values.max())
    return values if high == low else (values - low) / (high - low)


def _folded(volume: npt.ArrayLike, tail: int = 0) -> np.ndarray:
    """A map in single precision, reduced to its one value where it has only one."""
    value = np.asarray(volume)
    if value.ndim == tail:
        return value
    first = value[0, 0, 0]
    return np.array(first, float) if (value == first).all() else value.astype(np.float32)


def _axis(direction: str) -> int:
    if not isinstance(direction, str) or direction not in ("x", "y", "z"):
        raise InterfaceError(f"direction: expected 'x', 'y', 'z' or a vector of 3 numbers, got {shown(direction)}")
    return "xyz".index(direction)
