"""LIBERO's data on a category beyond its MJCF file: the file's path, when a joint is open, how resets turn it.

Facts from ``libero/envs/objects``. Joint positions are metres for drawers and radians for doors and knobs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from vecenv.errors import NotFound

_FAMILIES = ("stable_hope_objects", "stable_scanned_objects", "turbosquid_objects", "custom_objects")
# Categories whose file is not named after them.
_FILE_NAMES = {"rack": "simple_rack"}


class UnknownCategory(NotFound, KeyError):
    """A BDDL file names an object category that the asset tree does not have; the message names it."""

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


Turn: TypeAlias = tuple[str, float, float]
"""An axis and the bounds of a uniform draw of the angle about it, radians."""

_UPRIGHT: tuple[Turn, ...] = (("x", math.pi / 2, math.pi / 2),)
_AS_MODELLED: tuple[Turn, ...] = (("x", 0.0, 0.0),)
_ABOUT_Z: tuple[Turn, ...] = (("z", math.pi / 2, math.pi / 2),)
_FORWARD: tuple[Turn, ...] = (("x", -math.pi / 2, -math.pi / 2),)
_TILTED: tuple[Turn, ...] = (("x", math.pi / 4, math.pi / 2),)

# How upstream's samplers turn objects (``rotation`` and ``rotation_axis`` of the classes in libero/envs/objects).
TURNS: dict[str, tuple[Turn, ...]] = {
    **dict.fromkeys(
        (
            *("akita_black_bowl", "basket", "bbq_sauce", "bigger_akita_black_bowl", "black_bowl", "chefmate_8_frypan"),
            *("cookies", "glazed_rim_porcelain_ramekin", "green_bbq_sauce", "plate", "red_akita_black_bowl"),
            *("red_basket", "red_ramekin", "white_bowl", "yellow_bowl", "yellow_cookies", "yellow_plate"),
        ),
        _UPRIGHT,
    ),
    **dict.fromkeys(
        (
            *("alphabet_soup", "bigger_alphabet_soup", "bigger_milk", "blue_ketchup", "red_alphabet_soup"),
            *("tomato_sauce", "yellow_milk", "yellow_tomato_sauce"),
        ),
        _ABOUT_Z,
    ),
    **dict.fromkeys(
        (
            *("basin_faucet", "faucet", "microwave", "short_cabinet", "short_fridge", "slide_cabinet"),
            *("white_cabinet", "window", "wooden_cabinet", "yellow_cabinet"),
        ),
        _TILTED,
    ),
    **dict.fromkeys(("black_book", "yellow_book"), (("x", -math.pi / 2, -math.pi / 4),)),
    **dict.fromkeys(
        (
            *("bowl_drainer", "brown_rack", "butter", "chocolate_pudding", "cream_cheese", "desk_caddy"),
            *("dining_set_group", "green_butter", "green_chocolate_pudding", "moka_pot", "popcorn", "rack"),
            *("red_cream_cheese", "white_bottle", "wine_bottle", "wine_rack", "wine_rack_stand", "wooden_shelf"),
            *("wooden_tray", "wooden_two_layer_shelf", "yellow_desk_caddy", "yellow_moka_pot"),
        ),
        _AS_MODELLED,
    ),
    **dict.fromkeys(("flat_stove", "white_storage_box", "yellow_stove"), (("y", 0.0, 0.0),)),
    **dict.fromkeys(
        (
            *("green_ketchup", "ketchup", "macaroni_and_cheese", "milk", "new_salad_dressing", "orange_juice"),
            *("red_orange_juice", "red_salad_dressing", "salad_dressing"),
        ),
        (*_UPRIGHT, *_ABOUT_Z),
    ),
    "libero_mug_yellow": (
        ("x", -math.pi / 2, -math.pi / 2),
        ("y", -math.pi, -math.pi),
        ("z", math.pi, math.pi),
    ),
    **dict.fromkeys(
        ("porcelain_mug", "red_coffee_mug", "red_yellow_book", "white_porcelain_mug", "white_yellow_mug"), _FORWARD
    ),
}


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
