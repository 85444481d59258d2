"""The two sets of sentences in ``tests/data/``, and what the offline writer makes of each sentence.

A sentence is planned and carried out in ``offline_world``; the relations that hold afterwards are compared with those
that the file expects. The first file's head says what they mean. A fixed rule, the hash of the sentence, puts each
sentence into the half that the grammar is tuned on or into the one that is only scored.
"""

from __future__ import annotations

import collections
import functools
import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import vecenv
from support.offline_world import ToyWorld
from vecenv.observations import ObjectsSnapshot, PointCloud
from voxposer.language.lmp_config import LmpError

_DATA = Path(__file__).parents[1] / "data"
FILES = {"first": _DATA / "voxposer_sentences.yaml", "second": _DATA / "voxposer_sentences_second.yaml"}
HALVES = ("tuned", "held out")
# right; refused although there is a plan; refused for another reason; a plan with another outcome; an exception.
VERDICTS = ("right", "refused", "other reason", "wrong", "crash")
# Voxels along each axis, and how exactly a voxel of that size lets things be put, metres.
_SIZE, _EXACT = 80, 0.025


@dataclass(frozen=True, kw_only=True)
class Sentence:
    """A sentence and what it should come to; see the file's head."""

    scene: str
    say: str
    then: tuple[tuple[Any, ...], ...] = ()
    then_any: tuple[Any, ...] = ()
    order: tuple[str, ...] = ()
    avoiding: tuple[str, ...] = ()
    slow: bool = False
    refused: tuple[str, ...] = ()
    so_far: str = "right"

    @property
    def half(self) -> str:
        """Which half it is in."""
        return HALVES[hashlib.sha256(f"{self.scene}: {self.say}".encode()).digest()[0] % 2]

    @property
    def outcomes(self) -> Sequence[Sequence[tuple[Any, ...]]]:
        """Relations that would all do."""
        return self.then_any or (self.then,)


@dataclass(frozen=True)
class Verdict:
    """What became of a sentence: one of ``VERDICTS``, and what was seen."""

    kind: str
    detail: str = ""


def load(name: str) -> tuple[Sentence, ...]:
    """The sentences of a set, in order."""
    listed = yaml.safe_load(FILES[name].read_text())["sentences"]
    fields: list[dict[str, Any]] = [
        {key: tuple(value) if isinstance(value, list) else value for key, value in one.items()} for one in listed
    ]
    return tuple(Sentence(**one) for one in fields)


@functools.cache
def snapshots() -> Mapping[str, ObjectsSnapshot]:
    """The scenes of all sets by name."""
    described: dict[str, Any] = {}
    for file in FILES.values():
        described |= yaml.safe_load(file.read_text())["scenes"]
    found: dict[str, Any] = {name: _boxes(scene["boxes"]) for name, scene in described.items() if "boxes" in scene}
    by_suite: dict[str, list[str]] = collections.defaultdict(list)
    for name, scene in described.items():
        if "suite" in scene:
            by_suite[scene["suite"]].append(name)
    for suite, names in by_suite.items():
        env = vecenv.make(suite, tasks=[described[name]["task"] for name in names], episodes=[0])
        env.reset()
        found |= dict(zip(names, env.observe_objects().snapshot, strict=True))
        env.close()
    return found


def _boxes(boxes: Mapping[str, Sequence[float]]) -> ObjectsSnapshot:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    clouds = {name: PointCloud(corners * row[3:] + np.array(row[:3]), np.zeros((8, 3))) for name, row in boxes.items()}
    return ObjectsSnapshot(
        names=tuple(clouds),
        objects=clouds,
        poses={},
        regions={},
        goal=(),
        scene=PointCloud(np.zeros((0, 3)), np.zeros((0, 3))),
        ee_pose=np.array([-0.2, 0.0, 0.25, 0.0, 1.0, 0.0, 0.0]),
        gripper=np.array([0.04, -0.04]),
        workspace=np.array([[-0.7, -0.4, -0.1], [0.3, 0.5, 0.35]]),
        movable=tuple(clouds),
    )


@dataclass
class _WatchedWorld(ToyWorld):
    """A world that notes what motions kept away from, and how fast they were."""

    spared: list[frozenset[str]] = field(default_factory=list)
    speeds: list[float] = field(default_factory=list)

    def execute(self, movable: Any, affordance_map: Any = None, **maps: Any) -> None:
        if affordance_map:
            avoided = maps["avoidance_map"]() if maps.get("avoidance_map") else None
            self.spared.append(
                frozenset(
                    name
                    for name in self.snapshot.names
                    if avoided is not None and avoided[tuple(self.voxel(self.bounds(name).mean(axis=0)))] > 0.5
                )
            )
            self.speeds.append(float(maps["velocity_map"]().min()) if maps.get("velocity_map") else 1.0)
        super().execute(movable, affordance_map, **maps)


def judge(sentence: Sentence) -> Verdict:
    """Carry a sentence out and compare what it came to."""
    world = _WatchedWorld(snapshots()[sentence.scene], size=_SIZE)
    try:
        world.do(sentence.say)
    except LmpError as error:
        return _judge_refusal(sentence, str(error), world)
    except Exception as error:  # whatever it is, it is counted
        return Verdict("crash", f"{type(error).__name__}: {error}")
    if sentence.refused:
        return Verdict("wrong", f"should be refused; did {world.log}")
    missing = [_unmet(world, sentence, relations) for relations in sentence.outcomes]
    return Verdict("right") if not all(missing) else Verdict("wrong", f"{missing}; did {world.log}")


def _judge_refusal(sentence: Sentence, reason: str, world: ToyWorld) -> Verdict:
    if world.log:
        return Verdict("wrong", f"stopped after {world.log}: {reason}")
    # The query is quoted in the message; only what is said about it counts.
    told = reason.rpartition(sentence.say.rstrip(". "))[2]
    if not sentence.refused:
        return Verdict("refused", told)
    named = all(re.search(rf"(?<!\w)(?:{words})", told, re.IGNORECASE) for words in sentence.refused)
    return Verdict("right") if named else Verdict("other reason", told)


def _unmet(world: _WatchedWorld, sentence: Sentence, relations: Sequence[tuple[Any, ...]]) -> list[Any]:
    """What does not hold, what else was moved, and what the motions did not respect."""
    unmet: list[Any] = []
    named: set[str] = set()
    for kind, *given in relations:
        choices = [str(name) for name in str(given[0]).split("|")]
        held = [name for name in choices if _HOLDS[kind](world, name, *given[1:]) and _touched(world, name)]
        one = held[:1] if len(choices) > 1 else choices
        named.update(one)
        if len(held) != 1 and not (kind in {"open", "close", "turnoff"} and _HOLDS[kind](world, *given)):
            unmet.append((kind, *given))
    unmet += [("also", name) for name in _all_touched(world) if name not in named and not _alike(name, named)]
    seen = [name for what, name in world.log if what == "grasp" and name in sentence.order]
    if list(dict.fromkeys(seen)) != list(sentence.order):
        unmet.append(("order", seen))
    unmet += [("not spared", name) for name in sentence.avoiding if not all(name in spared for spared in world.spared)]
    if sentence.slow and not all(speed < 1 for speed in world.speeds):
        unmet.append(("not slow", world.speeds))
    return unmet


def _touched(world: ToyWorld, name: str) -> bool:
    return name in {thing for _, thing in world.log} or name not in world.snapshot.movable


def _all_touched(world: ToyWorld) -> list[str]:
    """What was moved, drawn or turned, in the end or on the way."""
    return list(dict.fromkeys(name for _, name in world.log if name))


def _alike(name: str, named: set[str]) -> bool:
    """A knob is named by its stove."""
    return any(name == f"{other}_knob" for other in named)


def _bounds(world: ToyWorld, name: str) -> tuple[np.ndarray, np.ndarray]:
    low, high = world.bounds(name)
    return low, high


def _supported(world: ToyWorld, thing: str, support: str) -> bool:
    """Whether it stands in the box of a part, or over the middle of a thing and no lower than it."""
    part = world.snapshot.parts.get(support) or world.snapshot.parts.get(f"{support}_inside")
    if part is not None and part.box is not None:
        moved = world._moved(support if support in world.snapshot.parts else part.parent)
        return world._within(thing, part.box, moved, 3 if part.kind != "burner" else 2)
    (low, high), (base, top) = _bounds(world, thing), _bounds(world, support)
    middle = (low + high)[:2] / 2
    inside = bool((middle > base[:2]).all() and (middle < top[:2]).all())
    return inside and thing != support and base[2] - 0.02 < low[2] < top[2] + 0.04


def _gap(world: ToyWorld, thing: str, other: str) -> float:
    """Horizontal distance of the bounds of two things, metres."""
    (low, high), (base, top) = _bounds(world, thing), _bounds(world, other)
    return float(np.linalg.norm(np.maximum(np.maximum(base - high, low - top), 0)[:2]))


def _is_beside(axis: int, sign: int) -> Callable[..., bool]:
    """On one side of another thing: beyond its bounds, and not beyond its bounds along the other axis."""

    def holds(world: ToyWorld, thing: str, other: str, cm: float | None = None) -> bool:
        (low, high), (base, top) = _bounds(world, thing), _bounds(world, other)
        gap = float(low[axis] - top[axis] if sign > 0 else base[axis] - high[axis])
        across = 1 - axis
        middle = (low + high)[across] / 2
        aligned = base[across] - _EXACT < middle < top[across] + _EXACT
        return bool(aligned and (abs(gap - cm / 100) < _EXACT if cm is not None else -_EXACT < gap < 0.15))

    return holds


def _is_near(world: ToyWorld, thing: str, other: str) -> bool:
    return _gap(world, thing, other) < 0.10 and not _supported(world, thing, other)


def _is_between(world: ToyWorld, thing: str, one: str, other: str) -> bool:
    middles = [(low + high)[:2] / 2 for low, high in (_bounds(world, name) for name in (thing, one, other))]
    way = middles[2] - middles[1]
    share = float((middles[0] - middles[1]) @ way / (way @ way))
    off = float(np.linalg.norm(middles[0] - middles[1] - share * way))
    return 0.25 < share < 0.75 and off < 0.04


_WAYS = {"left": (1, -1), "right": (1, 1), "front": (0, 1), "back": (0, -1)}


def _is_moved(world: ToyWorld, thing: str, way: str, least: float, most: float) -> bool:
    axis, sign = _WAYS[way]
    shift = world._moved(thing)
    return bool(least <= sign * shift[axis] * 100 <= most and abs(shift[1 - axis]) < _EXACT and abs(shift[2]) < _EXACT)


_HOLDS: Mapping[str, Callable[..., bool]] = {
    "in": _supported,
    "on": _supported,
    "left_of": _is_beside(1, -1),
    "right_of": _is_beside(1, 1),
    "front_of": _is_beside(0, 1),
    "back_of": _is_beside(0, -1),
    "near": _is_near,
    "between": _is_between,
    "moved": _is_moved,
    "open": lambda world, handle: world._drawn("open", f"{handle.removesuffix('_handle')}_region"),
    "close": lambda world, handle: world._drawn("close", f"{handle.removesuffix('_handle')}_region"),
    "turnon": lambda world, stove: world._switched("turnon", stove),
    "turnoff": lambda world, stove: world._switched("turnoff", stove),
    "held": lambda world, thing: world.held == thing,
}
