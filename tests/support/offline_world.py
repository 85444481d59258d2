"""A world without physics in which the offline writer's programs run: things are boxes, and go where they are put.

A snapshot of a real scene comes in; instructions are carried out by the programs that ``offline/libero`` writes, run in
the sandbox, with a hand that is where its last target was. What is left is held against the task's own goal. It shows
whether language and references are right; whether a grasp holds is for the simulator to say.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vecenv.observations import ObjectsSnapshot, RegionBox
from voxposer.language.llm import LlmConfig
from voxposer.language.lmp import build_lmps
from voxposer.language.observations import DynamicObservation, LazyMap, Observation
from voxposer.language.replies import NoRuleError, Reply
from voxposer.offline import provider as offline
from voxposer.offline.names import NotUnderstood

DOWN = np.array([0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True)
class Writer:
    """A language model that is the offline writer itself, without litellm between."""

    config: LlmConfig = field(default_factory=LlmConfig)

    def complete(self, messages: Any, *, stop: Any = (), max_tokens: int = 512, **_: Any) -> Reply:
        try:
            text, finish = _written(json.dumps(messages), tuple(stop), max_tokens)
        except NotUnderstood as error:
            raise NoRuleError(self.config.model, str(error)) from error
        if finish != "stop":
            raise NoRuleError(self.config.model, f"its program has more than {max_tokens} tokens")
        return Reply(text=text, model="writer", finish_reason=finish, prompt_tokens=0, completion_tokens=0, cost_usd=0)


@functools.lru_cache(maxsize=8192)
def _written(messages: str, stop: tuple[str, ...], max_tokens: int) -> tuple[str, str]:
    return offline.cut(offline.write(json.loads(messages)), stop, max_tokens)


class Seen(Observation):
    """An observation whose fields are computed when read."""

    def __getitem__(self, name: str, /) -> Any:
        return super().__getitem__(name)()


@dataclass
class ToyWorld:
    """Boxes and a hand.

    Attributes:
        snapshot: the scene at the start.
        llm: what writes the programs.
        size: voxels along each axis.
        ee: position of the hand, metres.
        quat: its orientation, wxyz.
        is_open: whether its fingers are apart.
        held: the thing or part between its fingers, "" for none.
        carried: what stands in or on it.
        shift: name -> how far a thing has moved, or a part has been drawn.
        turned: knob -> radians.
        log: what has been grasped, put, pushed and turned, in order.
    """

    snapshot: ObjectsSnapshot
    llm: Any = field(default_factory=Writer)
    size: int = 50
    ee: np.ndarray = field(default_factory=lambda: np.zeros(3))
    quat: np.ndarray = field(default_factory=lambda: DOWN.copy())
    is_open: bool = True
    held: str = ""
    carried: list[str] = field(default_factory=list)
    shift: dict[str, np.ndarray] = field(default_factory=dict)
    turned: dict[str, float] = field(default_factory=dict)
    log: list[tuple[str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.lo, self.hi = self.snapshot.workspace
        self.ee = self.home = np.array(self.snapshot.ee_pose[:3])
        self.names = (*self.snapshot.names, *self.snapshot.parts)
        self.lmps = build_lmps(self.functions(), self.llm)
        self.lmps.set_context(self.names)

    # -- voxels --------------------------------------------------------------------------------------------------------

    def voxel(self, point: np.ndarray) -> np.ndarray:
        ratio = (np.asarray(point) - self.lo) / (self.hi - self.lo)
        return np.clip(np.round(ratio * (self.size - 1)), 0, self.size - 1).astype(int)

    def point(self, voxel: np.ndarray) -> np.ndarray:
        return self.lo + np.asarray(voxel) / (self.size - 1) * (self.hi - self.lo)

    @property
    def _cm(self) -> np.ndarray:
        return (self.hi - self.lo) / self.size * 100

    def cm2index(self, cm: float, direction: Any) -> Any:
        if isinstance(direction, str):
            return int(cm / self._cm["xyz".index(direction)])
        unit = np.asarray(direction, float) / max(float(np.linalg.norm(direction)), 1e-9)
        return np.array([int(cm * part / size) for part, size in zip(unit, self._cm, strict=True)])

    def index2cm(self, index: float, direction: str | None = None) -> float:
        return float(index * (self._cm.mean() if direction is None else self._cm["xyz".index(direction)]))

    # -- things --------------------------------------------------------------------------------------------------------

    def _moved(self, name: str) -> np.ndarray:
        """How far a thing is from where it was; a part moves with the joint it shares with others."""
        part = self.snapshot.parts.get(name)
        if part is None:
            return self.shift.get(name, np.zeros(3))
        own = [other for other in self.shift if part.joint and _stem(other) == _stem(name) and other != part.parent]
        return sum((self.shift[other] for other in own), self._moved(part.parent))

    def bounds(self, name: str) -> np.ndarray:
        part = self.snapshot.parts.get(name)
        points = part.cloud.points if part else self.snapshot.objects[name].points
        return np.stack([points.min(axis=0), points.max(axis=0)]) + self._moved(name)

    def _grasp(self, name: str) -> np.ndarray:
        return self.bounds(name).mean(axis=0)

    def _rest(self, name: str) -> np.ndarray:
        """Where the underside of what is put there comes to be."""
        part = self.snapshot.parts.get(name)
        if part is not None and part.box is not None:
            return part.box.pos + self._moved(name)
        lo, hi = self.bounds(name)
        return np.array([*(lo + hi)[:2] / 2, hi[2]])

    def _under(self) -> np.ndarray:
        """From the middle of the held thing's underside to the hand."""
        if not self.held:
            return np.zeros(3)
        lo, hi = self.bounds(self.held)
        return self.ee - np.array([*(lo + hi)[:2] / 2, lo[2]])

    def detect(self, name: str) -> Seen:
        if name == "held object":
            name = self.held or "gripper"
        if name == "gripper":
            return Seen({key: self._hand_field(key) for key in ("name", "position", "aabb", "held")})
        if name == "table":
            ground = np.array([*(self.lo + self.hi)[:2] / 2, min(self.bounds(n)[0][2] for n in self.snapshot.movable)])
            return Seen({"position": lambda: self.voxel(ground)})
        assert name in self.names, f"nothing is called {name!r}"
        return self._thing(name)

    def _hand_field(self, key: str) -> Callable[[], Any]:
        return {
            "name": lambda: "gripper",
            "position": lambda: self.voxel(self.ee),
            "aabb": lambda: np.stack([self.voxel(self.ee)] * 2),
            "held": lambda: False,
        }[key]

    def _opening(self, name: str) -> np.ndarray | None:
        """The way a part opens: a door's handle along its circle; a knob's axis of turning."""
        part = self.snapshot.parts.get(name)
        if part is None or part.joint is None:
            return None
        if part.joint.kind == "slide" or part.kind == "knob":
            return part.joint.axis
        tangent = np.cross(part.joint.axis, self.bounds(name).mean(axis=0) - part.joint.anchor)
        return tangent / np.linalg.norm(tangent)

    def _thing(self, name: str) -> Seen:
        axis = self._opening(name)
        return Seen(
            {
                "name": lambda: name,
                "position": lambda: self.voxel(self.bounds(name).mean(axis=0)),
                "aabb": lambda: np.stack([self.voxel(end) for end in self.bounds(name)]),
                "grasp_position": lambda: self.voxel(self._grasp(name)),
                "grasp_quat": lambda: DOWN.copy(),
                "place_position": lambda: self.voxel(self._rest(name) + self._under()),
                "place_quat": lambda: DOWN.copy(),
                "corner_position": lambda: self.voxel(self._rest(name) + self._under()),
                "left_position": lambda: self.voxel(self._rest(name) + self._under() + self._aside(name, -1.0)),
                "left_quat": lambda: DOWN.copy(),
                "right_position": lambda: self.voxel(self._rest(name) + self._under() + self._aside(name, 1.0)),
                "right_quat": lambda: DOWN.copy(),
                "push_quat": lambda: DOWN.copy(),
                "hand_offset": lambda: self.voxel(self.ee) - self.voxel(self.ee - self._under()),
                "normal": lambda: np.array([0.0, 0.0, 1.0]),
                "axis": lambda: axis,
                "is_open": lambda: self._is_open(name),
                "held": lambda: name == self.held,
                "occupancy_map": lambda: np.zeros((self.size,) * 3),
            }
        )

    def _is_open(self, name: str) -> bool | None:
        """Whether a part with a joint is open, or switched on."""
        part = self.snapshot.parts.get(name)
        if part is None or part.joint is None:
            return None
        opened = part.joint.opened
        if part.kind == "knob":
            return opened + self.turned.get(name, 0.0) > 0.5 * part.joint.travel
        return self._drawn("open", f"{_stem(name)}_region")

    def _aside(self, name: str, side: float) -> np.ndarray:
        """From the middle of a thing to the middle of its left half (-1) or of its right one (1)."""
        low, high = self.bounds(name)
        return np.array([0.0, side * (high[1] - low[1]) / 4, 0.0])

    # -- language ------------------------------------------------------------------------------------------------------

    def functions(self) -> dict[str, Callable[..., Any]]:
        named = [self.detect, self.execute, self.cm2index, self.index2cm, self.set_voxel_by_radius]
        return {
            **{function.__name__: function for function in named},
            **{f"get_empty_{kind}_map": functools.partial(self._empty, kind) for kind in _EMPTY},
            "reset_to_default_pose": self._reset,
            "qmult": _qmult,
            "vec2quat": lambda vector: DOWN.copy(),
            "euler2quat": lambda roll, pitch, yaw: np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]),
        }

    def subtasks(self, instruction: str) -> tuple[str, ...]:
        return self.lmps.plan(instruction)

    def detected(self, phrase: str) -> Observation:
        """The one thing that a phrase means."""
        found = self.lmps.parse_query_obj(phrase)
        assert isinstance(found, DynamicObservation), f"{phrase!r} are several"
        return found()

    def do(self, instruction: str) -> ToyWorld:
        """Carry out an instruction."""
        for subtask in self.subtasks(instruction):
            self.lmps.composer(subtask)
        return self

    def _empty(self, kind: str) -> np.ndarray:
        if kind == "rotation":
            return np.broadcast_to(self.quat, (self.size,) * 3 + (4,)).copy()
        return np.full((self.size,) * 3, {"velocity": 1.0, "gripper": float(self.is_open)}.get(kind, 0.0))

    def set_voxel_by_radius(self, made: np.ndarray, xyz: Any, radius_cm: float = 0, value: Any = 1) -> None:
        at = np.clip(np.round(xyz), 0, self.size - 1).astype(int)
        reach = (radius_cm / self._cm).astype(int)
        made[tuple(slice(max(i - r, 0), i + r + 1) for i, r in zip(at, reach, strict=True))] = value

    # -- motion --------------------------------------------------------------------------------------------------------

    def _reset(self) -> None:
        self._move(self.home)

    def execute(self, movable: Any, affordance_map: LazyMap | None = None, **maps: LazyMap | None) -> None:
        targets = np.argwhere(affordance_map() == 1) if affordance_map else self.voxel(self.ee)[None]
        assert len(targets) == 1, f"{affordance_map.query if affordance_map else ''} has {len(targets)} targets"
        if movable["name"] != "gripper":
            self.log.append(("push", movable["name"]))
            goal = self.point(targets[0]) - self.bounds(movable["name"]).mean(axis=0)
            self.shift[movable["name"]] = self._moved(movable["name"]) + goal
            return
        quat = self._read(maps.get("rotation_map"), targets[0], self.quat)
        self._turn(np.asarray(quat, float))
        if affordance_map:
            self._move(self.point(targets[0]))
        self._grip(bool(self._read(maps.get("gripper_map"), targets[0], self.is_open)))

    def _read(self, made: LazyMap | None, voxel: np.ndarray, default: Any) -> Any:
        return default if made is None else made()[tuple(voxel)]

    def _turn(self, quat: np.ndarray) -> None:
        part = self.snapshot.parts.get(self.held)
        if part is not None and part.kind == "knob" and part.joint is not None:
            turn = _qmult(quat, self.quat * [1, -1, -1, -1])
            angle = 2 * np.arctan2(turn[1:] @ part.joint.axis, turn[0])
            self.turned[self.held] = self.turned.get(self.held, 0.0) + float(angle)
            self.log.append(("turn", self.held))
        self.quat = quat

    def _move(self, goal: np.ndarray) -> None:
        way, self.ee = goal - self.ee, goal
        if self.held in self.snapshot.objects:
            for name in (self.held, *self.carried):
                self.shift[name] = self._moved(name) + way
            return
        for name, part in self.snapshot.parts.items():
            axis = self._opening(name)
            if part.kind != "handle" or axis is None:
                continue
            if name == self.held:
                self._draw(name, float(way @ axis) * axis)
            elif not self.is_open and not self.held and way @ axis < 0 and self._pushes(name, goal - way, goal):
                self._draw(name, float((goal - self.bounds(name).mean(axis=0)) @ axis) * axis)

    def _pushes(self, name: str, start: np.ndarray, goal: np.ndarray) -> bool:
        """Whether a straight way leads through a handle."""
        handle = self.bounds(name).mean(axis=0)
        share = np.clip((handle - start) @ (goal - start) / max((goal - start) @ (goal - start), 1e-9), 0, 1)
        return bool(np.linalg.norm(start + share * (goal - start) - handle) < 0.03)

    def _draw(self, name: str, way: np.ndarray) -> None:
        """Move a handle as its joint lets it, with what hangs on it and what lies in that."""
        way = self._along_joint(name, way)
        self.log.append(("draw", name))
        parts = self.snapshot.parts.items()
        boxes = [
            part.box for other, part in parts if _stem(other) == _stem(name) and part.kind == "drawer" and part.box
        ]
        for thing in self.snapshot.movable:
            if any(self._within(thing, box, self._moved(name)) for box in boxes):
                self.shift[thing] = self._moved(thing) + way
        self.shift[name] = self.shift.get(name, np.zeros(3)) + way

    def _along_joint(self, name: str, way: np.ndarray) -> np.ndarray:
        joint = self.snapshot.parts[name].joint
        assert joint is not None
        if joint.kind == "slide":
            return way
        arm = self.bounds(name).mean(axis=0) - joint.anchor
        angle = float(np.cross(arm, way) @ joint.axis / np.linalg.norm(arm[:2]) ** 2)
        turned = arm * np.cos(angle) + np.cross(joint.axis, arm) * np.sin(angle)
        return np.array([*(turned - arm)[:2], 0.0])

    def _grip(self, is_open: bool) -> None:
        if is_open and not self.is_open and self.held:
            self.log.append(("put", self.held))
            self.held = ""
        if self.is_open and not is_open:
            parts = [name for name, part in self.snapshot.parts.items() if part.kind in {"handle", "knob"}]
            at = [
                name for name in (*self.snapshot.movable, *parts) if np.linalg.norm(self._grasp(name) - self.ee) < 0.03
            ]
            self.held = min(at, key=lambda name: float(np.linalg.norm(self._grasp(name) - self.ee)), default="")
            self.carried = self._resting_on(self.held) if self.held in self.snapshot.objects else []
            self.log.append(("grasp", self.held))
        self.is_open = is_open

    def _resting_on(self, name: str) -> list[str]:
        """The things that stand in or on a thing, and on those."""
        found, rest = [name], set(self.snapshot.movable) - {name}
        for carrier in found:
            low, high = self.bounds(carrier)
            for other in sorted(rest):
                (x, y), z = self.bounds(other).mean(axis=0)[:2], self.bounds(other)[0][2]
                if low[0] < x < high[0] and low[1] < y < high[1] and low[2] < z < high[2] + 0.03:
                    found.append(other)
                    rest.remove(other)
        return found[1:]

    # -- the goal ------------------------------------------------------------------------------------------------------

    def unmet(self) -> list[tuple[str, ...]]:
        """The goal's predicates that do not hold."""
        checks = {"on": self._on, "in": self._on, "open": self._drawn, "close": self._drawn}
        turns = {"turnon": self._switched, "turnoff": self._switched}
        return [goal for goal in self.snapshot.goal if not (checks | turns)[goal[0]](*goal)]

    def _on(self, _: str, thing: str, support: str) -> bool:
        box = self.snapshot.regions.get(support)
        if box is None:
            lo, hi = self.bounds(support)
            middle = self.bounds(thing).mean(axis=0)
            return bool((middle[:2] > lo[:2]).all() and (middle[:2] < hi[:2]).all())
        carrier = [name for name, part in self.snapshot.parts.items() if part.box is not None and _equal(part.box, box)]
        return self._within(thing, box, self._moved(carrier[0]) if carrier else np.zeros(3), 3 if carrier else 2)

    def _within(self, thing: str, box: RegionBox, moved: np.ndarray, axes: int = 3) -> bool:
        """Whether the middle of a thing's underside is in a box, give or take a voxel."""
        lo, hi = self.bounds(thing)
        local = np.abs(box.mat.T @ (np.array([*(lo + hi)[:2] / 2, lo[2]]) - box.pos - moved))
        return bool((local[:axes] < box.half_extents[:axes] + 0.02).all())

    def _drawn(self, wanted: str, region: str) -> bool:
        handle = f"{region.removesuffix('_region')}_handle"
        joint = self.snapshot.parts[handle].joint
        assert joint is not None
        if joint.kind == "slide":
            opened = joint.opened + float(self._moved(handle) @ joint.axis)
        else:
            start, end = (self.bounds(handle).mean(axis=0) - joint.anchor - shift for shift in (self._moved(handle), 0))
            opened = joint.opened + float(np.arctan2(np.cross(start, end) @ joint.axis, start[:2] @ end[:2]))
        return opened > 0.6 * joint.travel if wanted == "open" else opened < 0.1 * joint.travel

    def _switched(self, wanted: str, stove: str) -> bool:
        joint = self.snapshot.parts[f"{stove}_knob"].joint
        assert joint is not None
        angle = joint.opened + self.turned.get(f"{stove}_knob", 0.0)
        return angle > 0.5 if wanted == "turnon" else angle < 0.1


_EMPTY = ("affordance", "avoidance", "rotation", "velocity", "gripper")


def _stem(part: str) -> str:
    """What the parts that one joint moves have in common."""
    return part.rpartition("_")[0]


def _equal(one: RegionBox, other: RegionBox) -> bool:
    return one.parent == other.parent and np.allclose(one.pos, other.pos)


def _qmult(left: Any, right: Any) -> np.ndarray:
    w0, *v0 = np.asarray(left, float)
    w1, *v1 = np.asarray(right, float)
    return np.array([w0 * w1 - np.dot(v0, v1), *(w0 * np.array(v1) + w1 * np.array(v0) + np.cross(v0, v1))])
