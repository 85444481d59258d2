"""Geometry profiles: upstream's collision geoms as they are (``exact``), or at most 24 simple ones a scene (``lean``).

In: a scene's source and the tasks that will run in it. Out: a compiled scene with the same bodies, joints, sites, masses,
inertias, actuators and sensors, bit for bit, but other collision geoms. MJX's JAX implementation evaluates every pair of
geoms that could collide, so their number decides what a step costs. Which shape stands for which object is data
(:data:`RECIPES`); the fits are in ``vecenv.libero.primitives``. How much detail a thing gets depends on what the tasks
do with it: what is picked up or filled comes first, the rest of the budget goes down the list. The result is a pure
function of the source and :func:`demands`; :func:`lean_key` names everything else it depends on.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Protocol, TypeAlias

import mujoco
import numpy as np

from vecenv.libero import primitives as fits
from vecenv.libero.bddl import Predicate, Problem
from vecenv.libero.primitives import Solid
from vecenv.libero.scene import Entity, Scene, SceneError, SceneSource

PROFILES = ("exact", "lean")
# Raised whenever the same source and demands give another lean scene.
VERSION = 1
MAX_GEOMS = 24

# What may collide with what, as bits of contype and conaffinity. Parts of the surroundings never meet each other, but for
# a drawer's front and the cabinet's frame that stops it; nor do parts of the robot, but for the two pads. Pads meet what
# they can take hold of: elsewhere the fingers, which enclose them, are enough. The arm meets the surroundings only.
_SCENERY, _OBJECT, _PAD, _STOP, _MOVING = 1, 2, 4, 8, 16
_BITS = {
    "scenery": (_SCENERY, 0),
    "moving": (_SCENERY | _MOVING, 0),
    "frame": (_SCENERY | _STOP, 0),
    "front": (_SCENERY | _MOVING, _STOP),
    "object": (_OBJECT, _SCENERY | _OBJECT),
    "gripper": (0, _SCENERY | _OBJECT),
    "pad": (_PAD, _MOVING | _OBJECT | _PAD),
    "arm": (0, _SCENERY),
}

Demands: TypeAlias = Mapping[str, frozenset[str]]


# -- what tasks do with things -----------------------------------------------------------------------------------------


def demands(problems: Iterable[Problem]) -> Demands:
    """What tasks ask of each object and fixture, by name; what nothing is asked of is left out.

    ``held``: it is put somewhere. ``bears``: something is put or lies on it. ``filled:<region>``: something is put or
    lies in that region. ``worked:<region>``: the region's door or drawer, or with no region the thing's own joint, is
    opened, closed or turned. ``open:<region>``: it stands open at the beginning.
    """
    found: dict[str, set[str]] = {}
    for problem in problems:
        for predicate in problem.init:
            _note(found, problem, predicate, begins=True)
        for predicate in problem.goal:
            _note(found, problem, predicate, begins=False)
    return {name: frozenset(asked) for name, asked in sorted(found.items())}


def _note(found: dict[str, set[str]], problem: Problem, predicate: Predicate, *, begins: bool) -> None:
    if predicate.name in ("in", "on") and len(predicate.args) == 2:
        thing, place = predicate.args
        owner, region = _owner(problem, place)
        found.setdefault(owner, set()).add(f"filled:{region}" if predicate.name == "in" else "bears")
        if not begins:
            found.setdefault(thing, set()).add("held")
            if predicate.name == "in" and Predicate("open", (place,)) not in problem.init:
                found[owner].add(f"worked:{region}")
    elif predicate.name in ("open", "close", "turnon", "turnoff"):
        owner, region = _owner(problem, predicate.args[0])
        if not begins:
            found.setdefault(owner, set()).add(f"worked:{region}")
        elif predicate.name == "open":
            found.setdefault(owner, set()).add(f"open:{region}")


def _owner(problem: Problem, place: str) -> tuple[str, str]:
    """The thing that a place belongs to, and what the place is called there ("" for the thing itself)."""
    for region in problem.regions:
        if region.name == place:
            return region.target, place.removeprefix(f"{region.target}_")
    return place, ""


# -- recipes -----------------------------------------------------------------------------------------------------------


class Fit(Protocol):
    """A way to stand for solids with fewer of them."""

    @property
    def count(self) -> int:
        """How many geoms it makes at most."""
        ...

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """The geoms."""
        ...


@dataclass(frozen=True)
class Copy:
    """``count`` solids as they are."""

    count: int

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        if len(solids) != self.count:
            raise fits.FitError(f"{len(solids)} solids instead of {self.count}")
        return list(solids)


@dataclass(frozen=True)
class Boxes:
    """``count`` boxes, merged; heights along the body's axis ``up`` are kept."""

    count: int
    up: int = 2

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return fits.merge(solids, self.count, self.up)


@dataclass(frozen=True)
class Around:
    """The box around all."""

    count: int = 1

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return [fits.bound(solids)]


@dataclass(frozen=True)
class Block:
    """One box of the same height and outline area."""

    up: int = 2
    count: int = 1

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return [fits.block(solids, self.up)]


@dataclass(frozen=True)
class Filled:
    """A vessel as one box, handles left out; ``sink`` metres are taken off its top."""

    sink: float = 0.0
    count: int = 1

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return [fits.filled_vessel(solids, self.sink)]


@dataclass(frozen=True)
class Column:
    """A round column as crossed boxes."""

    up: int = 2
    count: int = 2

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return fits.column(solids, self.up, self.count)


@dataclass(frozen=True)
class Vessel:
    """A floor, a ring of walls, and handles."""

    walls: int
    handles: int = 0

    @property
    def count(self) -> int:
        """See `Fit`."""
        return 1 + self.walls + self.handles

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return fits.vessel(solids, self.walls, self.handles)


@dataclass(frozen=True)
class Capsule:
    """One capsule along the longest side."""

    count: int = 1

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return [fits.long_capsule(solids)]


@dataclass(frozen=True)
class EndCapsule:
    """One capsule that fits the end at the body's z; along a finger it is flush with the side ``inner``."""

    inner: tuple[float, float, float] | None = None
    count: int = 1

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        inner = None if self.inner is None else np.array(self.inner)
        return [fits.end_capsule(solids, np.array([0.0, 0.0, 1.0]), inner)]


@dataclass(frozen=True)
class Storey:
    """A cabinet's frame from the underside of one shelf to the top of another, as one block; its front is at -y.

    It takes the lower shelf, the upper one, and then the walls of the frame. Its front is that of the lower shelf, which
    is where the fronts of drawers come to rest.
    """

    count: int = 1

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        low, high, walls = (_corners([solids[0]]), _corners([solids[1]]), _corners(solids[2:]))
        bottom = np.array([walls[0][0], low[0][1], low[0][2]])
        top = np.array([walls[1][0], walls[1][1], high[1][2]])
        return [fits.box((bottom + top) / 2, np.eye(3), (top - bottom) / 2)]


def _corners(solids: Sequence[Solid]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates of solids in the frame of their body, [3] each."""
    around = fits.bound(solids, np.eye(3))
    return around.pos - around.size, around.pos + around.size


@dataclass(frozen=True)
class Part:
    """Geoms of one body and the fit that stands for them.

    Attributes:
        fit: the fit.
        geoms: the geoms' names after ``{entity}_``, in the order in which the fit wants them; empty for all of the body.
        body: the body's name after ``{entity}_``; None for the first one with collision geoms.
        meets: what it collides with, a row of the table at the top of this module; "" for what its kind does.
    """

    fit: Fit
    geoms: tuple[str, ...] = ()
    body: str | None = None
    meets: str = ""


Level: TypeAlias = tuple[Part, ...]


@dataclass(frozen=True)
class Module:
    """Part of a thing, in several levels of detail.

    Attributes:
        levels: coarse to fine; none but the coarsest may be empty.
        wanted: index of the level that the tasks need.
        needed: the tasks need it at all; others stay at their coarsest.
    """

    levels: tuple[Level, ...]
    wanted: int = 0
    needed: bool = False


def _count(level: Level) -> int:
    return sum(part.fit.count for part in level)


@dataclass(frozen=True)
class Recipe:
    """Levels of detail of a simple thing.

    Attributes:
        levels: coarse to fine.
        held: index of the level it needs when it is picked up or filled.
    """

    levels: tuple[Level, ...]
    held: int = 0

    def modules(self, asked: frozenset[str]) -> tuple[Module, ...]:
        """Its one module, given what is asked of it."""
        needed = bool(asked)
        used = "held" in asked or any(what.startswith("filled") for what in asked)
        return (Module(self.levels, self.held if used else 0, needed),)


@dataclass(frozen=True)
class Drawer:
    """Names of a drawer's geoms: floor, front, back, sides and handle, and the shelves below and above it."""

    region: str
    body: str
    floor: tuple[str, ...]
    front: tuple[str, ...]
    back: tuple[str, ...]
    sides: tuple[str, ...]
    handle: tuple[str, ...]
    below: str
    above: str

    def part(self, geoms: tuple[str, ...], meets: str = "") -> Part:
        """The box around some of its geoms."""
        return Part(Around(), geoms, self.body, meets)

    def levels(self, *, filled: bool, worked: bool) -> tuple[Level, ...]:
        """Its levels of detail, for how it is used."""
        floor, front, back = self.part(self.floor), self.part(self.front, "front"), self.part(self.back)
        sides = tuple(self.part((name,)) for name in self.sides)
        grip = (self.part(self.handle),) if worked else ()
        if filled:
            tray = (floor, front, *grip)
            return (tray, (*tray, *sides), (*tray, *sides, back))
        return (grip, (*grip, front)) if worked else ((),)


@dataclass(frozen=True)
class Cabinet:
    """A cabinet of drawers: the frame as blocks where no drawer is used, and the drawers that are.

    Attributes:
        drawers: from the lowest to the highest.
        frame: name of the frame's body.
        walls: names of the frame's geoms around the drawers.
        side_walls: those of its sides and back, one tuple a wall.
    """

    drawers: tuple[Drawer, ...]
    frame: str
    walls: tuple[str, ...]
    side_walls: tuple[tuple[str, ...], ...]

    def modules(self, asked: frozenset[str]) -> tuple[Module, ...]:
        """Frame and drawers, given what is asked of them."""
        hollow = [bool({f"filled:{d.region}", f"open:{d.region}"} & asked) for d in self.drawers]
        worked = [f"worked:{d.region}" in asked for d in self.drawers]
        blocks = self._blocks(hollow)
        sides = tuple(Part(Around(), wall, self.frame) for wall in self.side_walls)
        frames = (blocks, (*blocks, *sides)) if any(hollow) else (blocks,)
        modules = [Module(frames, 0, bool(asked))]
        for drawer, inside, hand in zip(self.drawers, hollow, worked, strict=True):
            modules.append(Module(drawer.levels(filled=inside, worked=hand), 0, inside or hand))
        return tuple(modules)

    def _blocks(self, hollow: Sequence[bool]) -> Level:
        """Runs of drawers that nothing goes into, as blocks; the top plate is always there."""
        parts = []
        for inside, run in itertools.groupby(zip(hollow, self.drawers, strict=True), key=lambda pair: pair[0]):
            drawers = [drawer for _, drawer in run]
            if not inside:
                parts.append(self._storey(drawers[0].below, drawers[-1].above))
        top = self.drawers[-1].above
        return (*parts, self._storey(top, top)) if hollow[-1] else tuple(parts)

    def _storey(self, low: str, high: str) -> Part:
        if low == high:
            return Part(Copy(1), (high,), self.frame)
        return Part(Storey(), (low, high, *self.walls), self.frame, "frame")


@dataclass(frozen=True)
class Jointed:
    """A thing with a moving part: levels of its body, and of the moving part when it is used and when not.

    Attributes:
        filled: levels of the body when something goes into it; ``solid`` otherwise.
        moving: levels of the moving part when a task moves it; ``idle`` otherwise.
    """

    solid: tuple[Level, ...]
    filled: tuple[Level, ...]
    idle: tuple[Level, ...]
    moving: tuple[Level, ...]

    def modules(self, asked: frozenset[str]) -> tuple[Module, ...]:
        """Body and moving part, given what is asked of them."""
        inside = any(what.startswith("filled") for what in asked)
        worked = any(what.startswith("worked") for what in asked)
        return (
            Module(self.filled if inside else self.solid, 0, bool(asked)),
            Module(self.moving if worked else self.idle, 0, bool(asked)),
        )


def _whole(*parts: Fit) -> Level:
    return tuple(Part(part) for part in parts)


def _numbered(*numbers: int) -> tuple[str, ...]:
    return tuple(f"g{number}" for number in numbers)


def _bowl(*walls: int) -> Recipe:
    return Recipe((_whole(Filled()), *(_whole(Vessel(n)) for n in walls)), held=1)


def _mug() -> Recipe:
    return Recipe((_whole(Filled()), *(_whole(Vessel(n, h)) for n, h in ((4, 0), (4, 1), (6, 1), (8, 1)))), held=1)


def _bottle(up: int, *counts: int) -> Recipe:
    return Recipe(tuple(_whole(Boxes(n, up)) for n in (1, *counts)), held=1)


def _can(up: int) -> Recipe:
    return Recipe((_whole(Block(up)), _whole(Column(up))), held=1)


def _as_is(count: int) -> Recipe:
    return Recipe((_whole(Copy(count)),))


def _drawer(name: str, front: int, floor: int, back: int, sides: tuple[int, int], shelves: tuple[int, int]) -> Drawer:
    return Drawer(
        region=f"{name}_region",
        body=f"cabinet_{name}",
        floor=_numbered(floor),
        front=_numbered(front),
        back=_numbered(back),
        sides=_numbered(*sides),
        handle=_numbered(floor + 2),
        below=f"g{shelves[0]}",
        above=f"g{shelves[1]}",
    )


_CABINET = Cabinet(
    drawers=(
        _drawer("bottom", 33, 38, 34, (36, 37), (7, 8)),
        _drawer("middle", 22, 27, 23, (25, 26), (8, 6)),
        _drawer("top", 11, 16, 13, (14, 15), (6, 9)),
    ),
    frame="base",
    walls=_numbered(1, 3, 4, 5),
    side_walls=(_numbered(3), _numbered(4), _numbered(1, 5)),
)

_KNOB = _numbered(19, 20, 21, 22)
_STOVE = Jointed(
    solid=((Part(Around(), ("base", "collision_burner"), "burner"),),),
    filled=((Part(Around(), ("base", "collision_burner"), "burner"),),),
    idle=((), (Part(Around(), body="button"),)),
    moving=(
        (Part(Boxes(1), _KNOB, "button"),),
        (Part(Boxes(1), _KNOB, "button"), Part(Around(), _numbered(*range(5, 19)), "button")),
    ),
)

_MICROWAVE = Jointed(
    solid=((Part(Around(), body="main"),),),
    filled=((Part(Boxes(5), body="main"),), (Part(Copy(6), body="main"),)),
    idle=((Part(Copy(1), _numbered(17), "microdoorroot"),),),
    moving=((Part(Copy(2), _numbered(17, 14), "microdoorroot"),),),
)

_RACK_PLANK, _RACK_LIP = Part(Copy(1), _numbered(1)), Part(Copy(1), _numbered(4))
_RACK_FOOT, _RACK_POST = Part(Around(), _numbered(7, 8, 9, 10)), Part(Copy(1), _numbered(11))
_RACK_LOWER = Part(Copy(1), _numbered(2))
_RACK = Recipe(
    (
        (_RACK_PLANK,),
        (_RACK_PLANK, _RACK_LIP),
        (_RACK_PLANK, _RACK_LIP, _RACK_FOOT),
        (_RACK_PLANK, _RACK_LIP, _RACK_FOOT, _RACK_POST, _RACK_LOWER),
    )
)

_BOTTLE_BODY = _numbered(3, *range(16, 24))
_BOTTLE_NECK = _numbered(4, *range(6, 15))

_CADDY = (
    *(Part(Copy(1), _numbered(n)) for n in (1, 4, 2, 3, 5, 8)),
    Part(Around(), _numbered(12, 7, 10)),
    Part(Around(), _numbered(6, 15, 14)),
    Part(Copy(1), _numbered(9)),
)

RECIPES: Mapping[str, Recipe | Cabinet | Jointed] = MappingProxyType(
    {
        "akita_black_bowl": _bowl(4, 5, 6, 8),
        "white_bowl": _bowl(4, 5, 6, 8),
        # A bowl sinks into it: in the settled starts of libero_spatial task 5 the bowl's foot, tilted by 16 degrees, lies
        # 6 to 13 mm below the rim.
        "glazed_rim_porcelain_ramekin": Recipe((_whole(Filled(sink=0.0097)), _whole(Vessel(4)), _whole(Vessel(6)))),
        "plate": Recipe(tuple(_whole(Vessel(n)) for n in (0, 4, 6, 8))),
        "porcelain_mug": _mug(),
        "red_coffee_mug": _mug(),
        "white_yellow_mug": _mug(),
        "chefmate_8_frypan": Recipe(tuple(_whole(Vessel(n, 1)) for n in (0, 4, 6, 8)), held=1),
        "moka_pot": Recipe(
            (
                (Part(Block(), _numbered(*range(2, 9))),),
                (Part(Column(), _numbered(*range(2, 9))), Part(Boxes(1), _numbered(*range(11, 16)))),
                (
                    Part(Column(), _numbered(*range(2, 9))),
                    Part(Boxes(2), _numbered(*range(11, 16))),
                    Part(Boxes(1), _numbered(9, 10)),
                    Part(Copy(1), _numbered(16)),
                ),
            ),
            held=1,
        ),
        "wine_bottle": Recipe(
            (
                _whole(Block()),
                (Part(Block(), _BOTTLE_BODY), Part(Block(), _BOTTLE_NECK)),
                (Part(Column(), _BOTTLE_BODY), Part(Block(), _BOTTLE_NECK)),
                (Part(Column(), _BOTTLE_BODY), Part(Block(), _BOTTLE_NECK), Part(Boxes(1), _numbered(5, 15))),
            ),
            held=1,
        ),
        "alphabet_soup": _can(1),
        "tomato_sauce": _can(1),
        "ketchup": _bottle(1, 2, 3),
        "salad_dressing": _bottle(1, 2, 3),
        "new_salad_dressing": _bottle(1, 2, 3),
        "bbq_sauce": _bottle(2, 2, 3),
        "milk": _bottle(1, 2, 4),
        "orange_juice": _bottle(1, 2, 4),
        "basket": _as_is(5),
        "wooden_tray": Recipe(
            (
                (Part(Around(), _numbered(5, 6, 7)), *(Part(Around(), _numbered(n)) for n in (1, 2, 3, 4))),
                (
                    Part(Around(), _numbered(5, 6, 7)),
                    *(Part(Around(), _numbered(n)) for n in (1, 2, 3, 4)),
                    *(Part(Around(), _numbered(n)) for n in (11, 12)),
                ),
            )
        ),
        "wooden_cabinet": _CABINET,
        "white_cabinet": _CABINET,
        "flat_stove": _STOVE,
        "microwave": _MICROWAVE,
        "wine_rack": _RACK,
        "desk_caddy": Recipe((_whole(Block()), _CADDY[:7], _CADDY[:8], _CADDY), held=1),
        "wooden_two_layer_shelf": Recipe(tuple(_whole(Boxes(n)) for n in (1, 5)), held=1),
    }
)

# Categories of LIBERO-PRO whose collision geoms are those of another one, recoloured or resized.
_LOOKS_LIKE = {
    "black_bowl": "akita_black_bowl",
    "bigger_akita_black_bowl": "akita_black_bowl",
    "yellow_plate": "plate",
    "bigger_alphabet_soup": "alphabet_soup",
    "blue_ketchup": "ketchup",
    "green_bbq_sauce": "bbq_sauce",
    "red_basket": "basket",
    "red_salad_dressing": "salad_dressing",
    "yellow_milk": "milk",
    "yellow_tomato_sauce": "tomato_sauce",
    "yellow_moka_pot": "moka_pot",
    "white_bottle": "wine_bottle",
    "brown_rack": "wine_rack",
    "yellow_cabinet": "wooden_cabinet",
    "yellow_stove": "flat_stove",
}


def recipe(category: str, solids: int) -> Recipe | Cabinet | Jointed:
    """The recipe of a category; for one that is not known, the boxes it is made of, merged where there are many."""
    known = RECIPES.get(_LOOKS_LIKE.get(category, category))
    if known is not None:
        return known
    counts = [count for count in (1, 2, 3, 5, 8) if count < solids]
    merged = tuple(_whole(Boxes(count)) for count in counts)
    levels = (*merged, _whole(Copy(solids))) if solids <= 8 else merged
    return Recipe(levels, held=min(2, len(levels) - 1))


# -- how the budget is spent -------------------------------------------------------------------------------------------

ROBOT = "robot"
_ROBOT_HAND: Level = (
    Part(EndCapsule(), body="gripper0_right_gripper"),
    Part(EndCapsule(inner=(0.0, -1.0, 0.0)), body="gripper0_leftfinger"),
    Part(EndCapsule(inner=(0.0, 1.0, 0.0)), body="gripper0_rightfinger"),
    Part(Copy(1), body="gripper0_finger_joint1_tip"),
    Part(Copy(1), body="gripper0_finger_joint2_tip"),
)
# Coarse to fine; the wrist matters more than the forearm.
_ROBOT_ARM: tuple[Level, ...] = (
    (),
    (Part(Capsule(), body="robot0_link6"),),
    (Part(Capsule(), body="robot0_link6"), Part(Capsule(), body="robot0_link5")),
)


@dataclass(frozen=True)
class Plan:
    """What a lean scene is made of.

    Attributes:
        levels: the parts of each thing, by name; the robot's under its base body's name.
        count: geoms at most, the support of everything included.
        short: things that got less than the tasks want.
    """

    levels: Mapping[str, tuple[Part, ...]]
    count: int
    short: tuple[str, ...]


def plan(scene: Scene, asked: Demands, budget: int = MAX_GEOMS) -> Plan:
    """Spend the budget: first what the tasks need, then the wrist, then more detail of what they need.

    What no task needs stays at its coarsest, however much is left: every geom costs time.

    Raises:
        SceneError: the coarsest level of everything exceeds the budget.
    """
    owners = [(e.name, module) for e in scene.entities.values() for module in _modules(scene, e, asked)]
    owners.append((ROBOT, Module(_ROBOT_ARM, 0, True)))
    chosen = [0] * len(owners)
    spent = 1 + _count(_ROBOT_HAND) + sum(_count(module.levels[0]) for _, module in owners)
    if spent > budget:
        raise SceneError(f"{spent} geoms are the least that this scene can be made of; the budget is {budget}")
    for _, index, level in sorted(_upgrades(owners)):
        levels = owners[index][1].levels
        extra = _count(levels[level]) - _count(levels[level - 1])
        if chosen[index] == level - 1 and spent + extra <= budget:
            chosen[index], spent = level, spent + extra
    parts: dict[str, tuple[Part, ...]] = {ROBOT: _ROBOT_HAND}
    for (name, module), level in zip(owners, chosen, strict=True):
        parts[name] = (*parts.get(name, ()), *module.levels[level])
    short = [name for (name, module), level in zip(owners, chosen, strict=True) if level < module.wanted]
    return Plan(MappingProxyType(parts), spent, tuple(dict.fromkeys(short)))


def _modules(scene: Scene, entity: Entity, asked: Demands) -> tuple[Module, ...]:
    solids = len(_entity_geoms(scene.model, entity))
    return recipe(entity.category, solids).modules(asked.get(entity.name, frozenset()))


def _upgrades(owners: Sequence[tuple[str, Module]]) -> list[tuple[float, int, int]]:
    """Every step to a finer level: its rank (lower comes first), the index of its module, the level."""
    steps = []
    for index, (name, module) in enumerate(owners):
        for level in range(1, len(module.levels) if module.needed else 1):
            beyond = max(0, level - module.wanted)
            steps.append((beyond - 0.5 if name == ROBOT else beyond, index, level))
    return steps


# -- the scene ---------------------------------------------------------------------------------------------------------


def lean_key(asked: Demands) -> str:
    """What a lean scene depends on besides its source, as text: the version of these fits and the demands."""
    return json.dumps(["lean", VERSION, {name: sorted(what) for name, what in sorted(asked.items())}])


def lean_scene(source: SceneSource, asked: Demands, exact: Scene | None = None) -> Scene:
    """The scene with at most ``MAX_GEOMS`` collision geoms, mostly boxes, and pairs that matter.

    Bodies, joints, sites, actuators, sensors, masses and inertias are those of the exact scene, bit for bit. The table
    becomes the plane of its top: what falls off its edge stays at that height.

    Args:
        source: the scene's source.
        asked: what the tasks do with its things, see :func:`demands`.
        exact: ``source.compile()``, when it is at hand.

    Raises:
        SceneError: MuJoCo refuses the model, or a thing does not look as its recipe expects.
    """
    exact = source.compile() if exact is None else exact
    return _Rebuild(source, exact).scene(plan(exact, asked))


@dataclass(frozen=True)
class _Made:
    """What became of a part: a body's id, solids in its frame, the geom whose parameters they take, their bits."""

    body: int
    solids: list[Solid]
    like: int
    meets: str


class _Rebuild:
    """Replaces the collision geoms of one scene."""

    def __init__(self, source: SceneSource, exact: Scene) -> None:
        self.source, self.exact = source, exact
        self.model = exact.model
        self.spec = mujoco.MjSpec.from_string(source.xml)
        self.made: dict[str, list[str]] = {}

    def scene(self, plan: Plan) -> Scene:
        support = self._support()
        lean = {name: self._fit(name, parts) for name, parts in plan.levels.items()}
        self._clear()
        self._add_support(*support)
        for name, parts in lean.items():
            for part in parts:
                self._add(name, part)
        self._keep_masses()
        self._drop_meshes()
        try:
            model = self.spec.compile()
        except ValueError as error:
            raise SceneError(f"{self.source.origin}: MuJoCo rejects the lean scene: {error}") from error
        entities = {
            name: replace(entity, contact_geoms=tuple(self.made.get(name, ())))
            for name, entity in self.exact.entities.items()
        }
        return replace(self.exact, model=model, entities=MappingProxyType(entities))

    def _fit(self, name: str, parts: Sequence[Part]) -> list[_Made]:
        """The solids of each part."""
        return [self._fit_part(name, part) for part in parts]

    def _fit_part(self, name: str, part: Part) -> _Made:
        body = self._body(name, part)
        named = {self.model.geom(g).name: g for g in _colliding(self.model, body)}
        wanted = [f"{name}_{suffix}" for suffix in part.geoms] or list(named)
        missing = [geom for geom in wanted if geom not in named]
        if missing:
            raise SceneError(f"{self.source.origin}: {name} has no collision geom {missing[0]!r}")
        solids = [solid_of(self.model, named[geom]) for geom in wanted]
        like = named[wanted[int(np.argmax([np.prod(solid.half_extents) for solid in solids]))]]
        try:
            return _Made(body, part.fit(solids), like, part.meets or self._meets(name, body))
        except fits.FitError as error:
            raise SceneError(f"{self.source.origin}: {name}: {error}") from error

    def _body(self, name: str, part: Part) -> int:
        if name == ROBOT:
            return self.model.body(part.body or "").id
        if part.body is not None:
            return self.model.body(f"{name}_{part.body}").id
        root = self.model.body(self.exact.entities[name].root_body).id
        return next(b for b in range(root, self.model.nbody) if len(_colliding(self.model, b)))

    def _support(self) -> tuple[int, np.ndarray, np.ndarray, int]:
        """Body, middle and half size of the top of table or floor, and the geom that is its largest part."""
        body = self.model.body(self.exact.arena.table_body).id
        geoms = [g for b in self._carried(body) for g in _colliding(self.model, b)]
        if self.model.geom_type[geoms[0]] == mujoco.mjtGeom.mjGEOM_PLANE:
            return body, self.model.geom_pos[geoms[0]].copy(), self.model.geom_size[geoms[0]].copy(), geoms[0]
        like = max(geoms, key=lambda g: float(_level_area(solid_of(self.model, g))))
        body = int(self.model.geom_bodyid[like])
        top = fits.bound([solid_of(self.model, like)], np.eye(3))
        pos = top.pos + [0.0, 0.0, top.size[2]]
        return body, pos, np.array([*top.size[:2], 0.01]), like

    def _carried(self, body: int) -> list[int]:
        """A fixed body and those fixed to it."""
        weld = self.model.body_weldid
        return [b for b in range(body, self.model.nbody) if weld[b] == weld[body] and self._below(b, body)]

    def _below(self, body: int, root: int) -> bool:
        while body > root:
            body = int(self.model.body_parentid[body])
        return body == root

    def _clear(self) -> None:
        """Take the hidden collision geoms away; geoms that are seen as well stay, without colliding."""
        for geom in list(self.spec.geoms):
            if not (geom.contype or geom.conaffinity):
                continue
            if geom.group == 0:
                self.spec.delete(geom)
            else:
                geom.contype = geom.conaffinity = 0

    def _add_support(self, body: int, pos: np.ndarray, size: np.ndarray, like: int) -> None:
        name = self.model.body(body).name
        plane = self._geom(body, f"{name or 'world'}_support", like, "scenery")
        plane.type, plane.pos, plane.size = mujoco.mjtGeom.mjGEOM_PLANE, pos, size

    def _add(self, name: str, part: _Made) -> None:
        for solid in part.solids:
            label = f"{name}_lean{len(self.made.setdefault(name, []))}"
            geom = self._geom(part.body, label, part.like, part.meets)
            geom.type = _TYPES[solid.kind]
            geom.pos, geom.size = solid.pos, solid.size
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, solid.mat.ravel())
            geom.quat = quat
            self.made[name].append(label)

    def _meets(self, name: str, body: int) -> str:
        if name != ROBOT:
            if not self.exact.entities[name].fixture:
                return "object"
            return "moving" if self.model.body_dofnum[body] else "scenery"
        label = self.model.body(body).name
        if label.startswith("gripper0_"):
            return "pad" if label.endswith("_tip") else "gripper"
        return "arm"

    def _geom(self, body: int, name: str, like: int, meets: str) -> mujoco.MjsGeom:
        """A new geom with another one's contact parameters."""
        model, geom = self.model, self.spec.bodies[body].add_geom(name=name)
        geom.contype, geom.conaffinity = _BITS[meets]
        geom.group = 0
        geom.condim, geom.priority = int(model.geom_condim[like]), int(model.geom_priority[like])
        geom.friction, geom.solmix = model.geom_friction[like], float(model.geom_solmix[like])
        geom.solref, geom.solimp = model.geom_solref[like], model.geom_solimp[like]
        geom.margin, geom.gap = float(model.geom_margin[like]), float(model.geom_gap[like])
        return geom

    def _keep_masses(self) -> None:
        """State every body's inertia as it was computed from the exact geoms, and the scene's extent likewise."""
        for index, body in enumerate(self.spec.bodies):
            if index:
                body.explicitinertial = True
                body.mass, body.inertia = float(self.model.body_mass[index]), self.model.body_inertia[index]
                body.ipos, body.iquat = self.model.body_ipos[index], self.model.body_iquat[index]
        for name in ("center", "extent", "meanmass", "meansize"):
            setattr(self.spec.stat, name, getattr(self.model.stat, name))

    def _drop_meshes(self) -> None:
        used = {geom.meshname for geom in self.spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH}
        for mesh in list(self.spec.meshes):
            if mesh.name not in used:
                self.spec.delete(mesh)


_TYPES = {fits.BOX: mujoco.mjtGeom.mjGEOM_BOX, fits.CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE}


def _level_area(solid: Solid) -> float:
    """Area of a solid's box seen from above."""
    around = fits.bound([solid], np.eye(3))
    return float(around.size[0] * around.size[1])


def _colliding(model: mujoco.MjModel, body: int) -> list[int]:
    """Collision geoms of a body."""
    first = model.body_geomadr[body]
    geoms = range(first, first + model.body_geomnum[body])
    return [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]


def _entity_geoms(model: mujoco.MjModel, entity: Entity) -> list[int]:
    """Collision geoms of a thing and of what moves on it."""
    root = model.body(entity.root_body).id
    bodies = np.flatnonzero(model.body_rootid == root)
    return [g for body in bodies for g in _colliding(model, int(body))]


def solid_of(model: mujoco.MjModel, geom: int) -> Solid:
    """A geom of a compiled model as a solid in its body's frame.

    Raises:
        SceneError: it is neither box, sphere, capsule, cylinder nor mesh.
    """
    pos, mat, size = model.geom_pos[geom].copy(), np.zeros(9), model.geom_size[geom].copy()
    mujoco.mju_quat2Mat(mat, model.geom_quat[geom])
    mat = mat.reshape(3, 3)
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return Solid(fits.BOX, pos, mat, size)
    if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE):
        half = size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
        return Solid(fits.CAPSULE, pos, mat, np.array([size[0], half, 0.0]))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return Solid(fits.CYLINDER, pos, mat, size)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _hull(model, geom, pos, mat)
    raise SceneError(f"geom {model.geom(geom).name!r} is a {kind.name}, which no fit knows")


def _hull(model: mujoco.MjModel, geom: int, pos: np.ndarray, mat: np.ndarray) -> Solid:
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    local = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
    low, high = local.min(axis=0), local.max(axis=0)
    centre = pos + mat @ ((low + high) / 2)
    return Solid(fits.HULL, centre, mat, (high - low) / 2, points=pos + local @ mat.T)
