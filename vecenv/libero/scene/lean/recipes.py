"""Which simple shapes replace which LIBERO object, in several levels of detail: the data behind lean geometry.

In: a category. Out: its recipe, whose kinds are in ``vecenv.libero.scene.lean.detail``. The fits are in
``vecenv.libero.scene.lean.fits``, how much detail a thing gets is up to ``vecenv.libero.scene.lean.geometry``.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from vecenv.libero.scene.lean.detail import Cabinet, Drawer, Jointed, Level, Part, Recipe
from vecenv.libero.scene.lean.fits import (
    Around,
    Block,
    Boxes,
    Capsule,
    Column,
    Copy,
    EndCapsule,
    Filled,
    Fit,
    Vessel,
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
