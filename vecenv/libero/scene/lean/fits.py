"""Ways to replace solids by fewer of them, as values: which formula, with which numbers.

A recipe (``vecenv.libero.scene.lean.recipes``) names one of these for each part of a thing; the formulas are in
``boxes``, ``vessels`` and ``capsules``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vecenv.libero.scene.lean import boxes, capsules, vessels
from vecenv.libero.scene.lean.solids import FitError, Solid, box


class Fit(Protocol):
    """A way to replace solids by fewer of them."""

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
            raise FitError(f"{len(solids)} solids instead of {self.count}")
        return list(solids)


@dataclass(frozen=True)
class Boxes:
    """``count`` boxes, merged; heights along the body's axis ``up`` are kept."""

    count: int
    up: int = 2

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return boxes.merge(solids, self.count, self.up)


@dataclass(frozen=True)
class Around:
    """The box around all."""

    count: int = 1

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return [boxes.bound(solids)]


@dataclass(frozen=True)
class Block:
    """One box of the same height and outline area."""

    up: int = 2
    count: int = 1

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return [boxes.block(solids, self.up)]


@dataclass(frozen=True)
class Filled:
    """A vessel as one box, handles left out; ``sink`` metres are taken off its top."""

    sink: float = 0.0
    count: int = 1

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return [vessels.filled_vessel(solids, self.sink)]


@dataclass(frozen=True)
class Column:
    """A round column as crossed boxes."""

    up: int = 2
    count: int = 2

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return boxes.column(solids, self.up, self.count)


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
        return vessels.vessel(solids, self.walls, self.handles)


@dataclass(frozen=True)
class Capsule:
    """One capsule along the longest side."""

    count: int = 1

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        return [capsules.long_capsule(solids)]


@dataclass(frozen=True)
class EndCapsule:
    """One capsule that fits the end at the body's z; along a finger it is flush with the side ``inner``."""

    inner: tuple[float, float, float] | None = None
    count: int = 1

    def __call__(self, solids: Sequence[Solid]) -> list[Solid]:
        """See `Fit`."""
        inner = None if self.inner is None else np.array(self.inner)
        return [capsules.end_capsule(solids, np.array([0.0, 0.0, 1.0]), inner)]


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
        return [box((bottom + top) / 2, np.eye(3), (top - bottom) / 2)]


def _corners(solids: Sequence[Solid]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates of solids in the frame of their body, [3] each."""
    around = boxes.bound(solids, np.eye(3))
    return around.pos - around.size, around.pos + around.size
