"""Levels of detail of things: parts, modules, and the levels that each kind of thing offers for its uses.

In: what tasks do with a thing (``vecenv.libero.scene.lean.geometry.demands``). Out: modules, each a ladder of levels
from coarse to fine; a level is a list of parts, a part names upstream's collision geoms and the fit that replaces
them. Geoms are called what upstream's files call them after the thing's own name (``g18``).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from vecenv.libero.scene.lean.fits import Around, Copy, Fit, Storey


@dataclass(frozen=True)
class Part:
    """Geoms of one body and the fit that replaces them.

    Attributes:
        fit: the fit.
        geoms: the geoms' names after ``{entity}_``, in the order that the fit expects; empty for all of the
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
        """Its one module, for these uses."""
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
        """Frame and drawers, for these uses."""
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
        """Body and moving part, for these uses."""
        inside = any(what.startswith("filled") for what in asked)
        worked = any(what.startswith("worked") for what in asked)
        return (
            Module(self.filled if inside else self.solid, 0, bool(asked)),
            Module(self.moving if worked else self.idle, 0, bool(asked)),
        )
