"""What LIBERO knows about an object category beyond its MJCF file: where the file lies, when a joint counts as open.

Facts from ``libero/envs/objects``. Joint positions are metres for drawers and radians for doors and knobs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

_FAMILIES = ("stable_hope_objects", "stable_scanned_objects", "turbosquid_objects", "custom_objects")
# Categories whose file is not named after them.
_FILE_NAMES = {"rack": "simple_rack"}


class UnknownCategory(KeyError):
    """A BDDL file asks for an object category that the asset tree does not have; the message names it."""

    def __str__(self) -> str:
        return str(self.args[0])


@dataclass(frozen=True, kw_only=True)
class JointTest:
    """A one-sided test of a joint position: ``qpos < bound``, ``qpos > bound`` or ``qpos >= bound``."""

    op: str
    bound: float

    def sign_form(self) -> tuple[float, float, bool]:
        """``(s, b, inclusive)`` such that the test is ``s * qpos > b`` (or ``>=`` when inclusive)."""
        return {
            "<": (-1.0, -self.bound, False),
            ">": (1.0, self.bound, False),
            ">=": (1.0, self.bound, True),
        }[self.op]


@dataclass(frozen=True, kw_only=True)
class Articulation:
    """Which joint positions mean what; None where the category has no such notion.

    Attributes:
        is_open, is_close: tests of one joint for Open and Close.
        turn_on, turn_off: tests of one joint for TurnOn and TurnOff.
        open_range, close_range, on_range, off_range: joint positions that upstream's reset draws from.
    """

    is_open: JointTest | None = None
    is_close: JointTest | None = None
    turn_on: JointTest | None = None
    turn_off: JointTest | None = None
    open_range: tuple[float, float] | None = None
    close_range: tuple[float, float] | None = None
    on_range: tuple[float, float] | None = None
    off_range: tuple[float, float] | None = None


def _cabinet_opening_to_minus_y() -> Articulation:
    return Articulation(
        is_open=JointTest(op="<", bound=-0.14),
        is_close=JointTest(op=">", bound=0.0),
        open_range=(-0.16, -0.14),
        close_range=(0.0, 0.005),
    )


def _stove() -> Articulation:
    return Articulation(
        turn_on=JointTest(op=">=", bound=0.5),
        turn_off=JointTest(op="<", bound=0.0),
        on_range=(0.5, 2.1),
        off_range=(-0.005, 0.0),
    )


ARTICULATIONS: dict[str, Articulation] = {
    "microwave": Articulation(
        is_open=JointTest(op="<", bound=-1.3),
        is_close=JointTest(op=">", bound=-0.005),
        open_range=(-2.094, -1.3),
        close_range=(-0.005, 0.0),
    ),
    "short_cabinet": Articulation(
        is_open=JointTest(op=">", bound=0.10),
        is_close=JointTest(op="<", bound=0.0),
        open_range=(0.10, 0.16),
        close_range=(-0.005, 0.0),
    ),
    "short_fridge": Articulation(
        is_open=JointTest(op=">", bound=2.0),
        is_close=JointTest(op="<", bound=0.0),
        open_range=(2.0, 2.7),
        close_range=(-0.005, 0.0),
    ),
    "wooden_cabinet": _cabinet_opening_to_minus_y(),
    "white_cabinet": _cabinet_opening_to_minus_y(),
    "yellow_cabinet": _cabinet_opening_to_minus_y(),
    "flat_stove": _stove(),
    "yellow_stove": _stove(),
}


def articulation(category: str) -> Articulation:
    """The joint semantics of a category; an empty one for things without joints."""
    return ARTICULATIONS.get(category.lower(), Articulation())


def asset_file(category: str, assets_root: Path) -> Path:
    """The MJCF file of an object category.

    Raises:
        UnknownCategory: no family of the asset tree has it.
    """
    key = category.lower()
    stem = _FILE_NAMES.get(key, key)
    candidates = [assets_root / family / stem / f"{stem}.xml" for family in _FAMILIES]
    candidates.append(assets_root / "articulated_objects" / f"{stem}.xml")
    for path in candidates:
        if path.is_file():
            return path
    raise UnknownCategory(f"object category {category!r} has no asset file below {assets_root}")
