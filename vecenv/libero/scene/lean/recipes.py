"""Which simple shapes stand for which LIBERO object, in several levels of detail: the data behind lean geometry.

In: a category and what tasks do with a thing of it. Out: modules, each a ladder of levels from coarse to fine; a level
is a list of parts, a part names upstream's collision geoms and the fit that stands for them. Geoms are called what
upstream's files call them after the thing's own name (``g18``). The fits are in
``vecenv.libero.scene.lean.primitives``, how much detail a thing gets is up to ``vecenv.libero.scene.lean.geometry``.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol, TypeAlias

import numpy as np

from vecenv.libero.scene.lean import primitives as fits
from vecenv.libero.scene.lean.primitives import Solid


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

    It takes the lower shelf, the upper one, and then the walls of the frame. Its front is that of the lower shelf,
    where the fronts of drawers come to rest.
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
        geoms: the geoms' names after ``{entity}_``, in the order in which the fit wants them; empty for all of the
            body's.
        body: the body's name after ``{entity}_``; None for the first one with collision geoms.
        meets: what it collides with, a row of ``vecenv.libero.scene.lean.geometry``'s table; "" for what its kind does.
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


def count(level: Level) -> int:
    """How many geoms a level has at most."""
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
        # A bowl sinks into it: in the settled starts of libero_spatial task 5 the bowl's foot, tilted by 16 degrees,
        # lies 6 to 13 mm below the rim.
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


# The robot's parts name whole bodies.
ROBOT_HAND: Level = (
    Part(EndCapsule(), body="gripper0_right_gripper"),
    Part(EndCapsule(inner=(0.0, -1.0, 0.0)), body="gripper0_leftfinger"),
    Part(EndCapsule(inner=(0.0, 1.0, 0.0)), body="gripper0_rightfinger"),
    Part(Copy(1), body="gripper0_finger_joint1_tip"),
    Part(Copy(1), body="gripper0_finger_joint2_tip"),
)
# The wrist matters more than the forearm; the rest of the arm stays above the robot's base.
ROBOT_ARM: tuple[Level, ...] = (
    (),
    (Part(Capsule(), body="robot0_link6"),),
    (Part(Capsule(), body="robot0_link6"), Part(Capsule(), body="robot0_link5")),
)
