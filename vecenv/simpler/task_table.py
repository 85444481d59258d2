"""Data of SIMPLER's 25 tasks: cameras, lights, stages, objects, and one row a task.

Names, order and values are upstream's under ``prepackaged_config=True``, its visual-matching evaluation (SimplerEnv
commit 4ab7178, ManiSkill2_real2sim commit ef7a4d4). A row has the fields of a ``SimplerTask`` except its index.
"""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

import numpy as np

from vecenv.simpler.control.robots import GOOGLE_ROBOT, WIDOWX
from vecenv.simpler.task_spec import (
    BRIDGE,
    DATA,
    DRAWERS,
    GOOGLE,
    Camera,
    DirectionalLight,
    DrawerSuccess,
    Lighting,
    MoveNearSuccess,
    PickSuccess,
    PlaceSuccess,
    PutOnSuccess,
    StageSpec,
    Success,
)

# ---------------------------------------------------------------------------------------------------------------------
# Cameras, light and surroundings.

_LOGITECH: dict[str, Any] = {
    "name": "3rd_view_camera",
    "link": "base_link",
    "width": 640,
    "height": 480,
    "focal": (623.588, 623.588),
    "centre": (319.501, 239.545),
}
BRIDGE_CAMERA = Camera(**_LOGITECH, position=(0.0, -0.16, 0.36), quat=(0.8992917, -0.09263245, 0.35892478, 0.23209205))
SINK_CAMERA = Camera(
    **_LOGITECH, position=(-0.00300001, -0.21, 0.39), quat=(-0.907313, 0.0782, -0.36434, -0.194741), near=0.01
)
GOOGLE_CAMERA = Camera(
    name="overhead_camera",
    link="link_camera",
    position=(0.0, 0.0, 0.0),
    quat=(0.5, 0.5, -0.5, 0.5),
    width=640,
    height=512,
    focal=(425.0, 425.0),
    centre=(320.0, 256.0),
)


def _light(direction: tuple[float, float, float], brightness: float, shadow: bool = False) -> DirectionalLight:
    return DirectionalLight(direction=direction, colour=(brightness, brightness, brightness), shadow=shadow)


TABLE_LIGHT = Lighting(
    ambient=(0.3, 0.3, 0.3),
    directional=(_light((0, 0, -1), 2.2, shadow=True), _light((-1, -0.5, -1), 0.7), _light((1, 1, -1), 0.7)),
)
SINK_LIGHT = Lighting(ambient=(0.3, 0.3, 0.3), directional=(_light((0, 0, -1), 0.3, shadow=True),))
_STEEP = float(np.deg2rad(75))
STATION_LIGHT = Lighting(
    ambient=(1.0, 1.0, 1.0), directional=(_light((-float(np.cos(_STEEP)), 0, -float(np.sin(_STEEP))), 1.0),)
)

_BRIDGE_OFFSET, _GOOGLE_OFFSET = (-2.0634, -2.8313, 0.0), (-1.6616, -3.0337, 0.0)
BRIDGE_TABLE = StageSpec(name="bridge_table_1_v1", offset=_BRIDGE_OFFSET)
SINK_TABLE = StageSpec(name="bridge_table_1_v2", offset=_BRIDGE_OFFSET)
COKE_TABLE = StageSpec(name="google_pick_coke_can_1_v4", offset=_GOOGLE_OFFSET)
BARE_FLOOR = StageSpec(name=None, offset=_GOOGLE_OFFSET)


def _image(name: str) -> PurePosixPath:
    return DATA / "real_inpainting" / f"{name}.png"


# ---------------------------------------------------------------------------------------------------------------------
# The tasks.

PICK_MODELS = (
    "opened_pepsi_can",
    "opened_coke_can",
    "opened_sprite_can",
    "opened_fanta_can",
    "opened_redbull_can",
    "blue_plastic_bottle",
    "apple",
    "orange",
    "sponge",
    "bridge_spoon_generated_modified",
    "bridge_carrot_generated_modified",
    "green_cube_3cm",
    "yellow_cube_3cm",
    "eggplant",
)
# All objects of info_pick_custom_baked_tex_v1.json, sorted, as upstream draws from them.
PLACE_MODELS = (
    "7up_can",
    "apple",
    "baked_apple_v2",
    "baked_blue_plastic_bottle_v2",
    "baked_opened_7up_can_v2",
    "baked_opened_coke_can_v2",
    "baked_opened_pepsi_can_v2",
    "baked_opened_redbull_can_v2",
    "baked_orange_v2",
    "baked_sponge_v2",
    "blue_plastic_bottle",
    "coke_can",
    "fanta_can",
    "opened_coke_can",
    "opened_fanta_can",
    "opened_sprite_can",
    "orange",
    "pepsi_can",
    "redbull_can",
    "sponge",
    "sprite_can",
)


def _triplets(prefix: str, suffix: str = "") -> tuple[tuple[str, str, str], ...]:
    pepsi, seven_up, coke, redbull = (
        f"{prefix}opened_{brand}_can{suffix}" for brand in ("pepsi", "7up", "coke", "redbull")
    )
    apple, sponge = f"{prefix}apple{suffix}", f"{prefix}sponge{suffix}"
    return (
        ("blue_plastic_bottle", pepsi, "orange"),
        (seven_up, apple, sponge),
        (coke, redbull, apple),
        (sponge, "blue_plastic_bottle", seven_up),
        ("orange", pepsi, redbull),
    )


PLAIN_TRIPLETS = _triplets("")
"""Groups of ``move_near`` in variant aggregation: visual matching's without the light baked into their textures."""
PLAIN_MODELS_FILE = "info_pick_custom_v0.json"
"""Sizes and densities of the objects of ``pick`` and of those groups."""


def _google(name: str, family: str, instruction: str, success: Success, **fields: object) -> dict[str, Any]:
    return {
        "suite": GOOGLE,
        "name": f"google_robot_{name}",
        "family": family,
        "instruction": instruction,
        "robot": GOOGLE_ROBOT,
        "camera": GOOGLE_CAMERA,
        "success": success,
        **fields,
    }


def _pick(name: str, instruction: str, models: tuple[str, ...], orientation: str | None = None) -> dict[str, Any]:
    return _google(
        name,
        "pick",
        instruction,
        PickSuccess(),
        max_steps=80,
        models=models,
        orientation=orientation,
        models_file=PLAIN_MODELS_FILE,
        stage=COKE_TABLE,
        overlays=(_image("google_coke_can_real_eval_1"),),
        lighting=TABLE_LIGHT,
    )


def _move_near(name: str, version: int) -> dict[str, Any]:
    return _google(
        name,
        "move_near",
        "move SOURCE near TARGET",
        MoveNearSuccess(),
        max_steps=80,
        triplets=_triplets("baked_", "" if version == 0 else "_v2"),
        models_file=f"info_pick_custom_baked_tex_v{version}.json",
        stage=COKE_TABLE,
        contact_offset=0.005,
        overlays=(_image("google_move_near_real_eval_1"),),
        lighting=TABLE_LIGHT,
        matte=version == 1,
    )


_STATION: dict[str, Any] = {
    "stage": BARE_FLOOR,
    "station": DATA / "custom/mk_station_recolor.urdf",
    "lighting": STATION_LIGHT,
    "ray_traced": True,
    "shiny": False,
}


def _drawer(verb: str, which: str | None) -> dict[str, Any]:
    opens = verb == "open"
    return _google(
        f"{verb}_{which}_drawer" if which else f"{verb}_drawer",
        verb,
        f"{verb} {which or 'WHICH'} drawer",
        DrawerSuccess(threshold=0.15, opens=True) if opens else DrawerSuccess(threshold=0.05, opens=False, start=0.2),
        max_steps=113,
        drawers=(which,) if which else DRAWERS,
        overlays=tuple(_image(f"open_drawer_{row}{column}") for row in "abc" for column in "012"),
        **_STATION,
    )


def _place(name: str, which: str | None, models: tuple[str, ...] = PLACE_MODELS) -> dict[str, Any]:
    return _google(
        f"place_{name}",
        "place",
        f"open {which or 'WHICH'} drawer",
        PlaceSuccess(),
        max_steps=200,
        models=models,
        drawers=(which,) if which else DRAWERS,
        models_file="info_pick_custom_baked_tex_v1.json",
        contact_offset=0.005,
        overlays=tuple(_image(f"open_drawer_{row}0") for row in "abc"),
        **_STATION,
    )


def _put_on(
    name: str, instruction: str, source: str, target: str, success: Success, **fields: object
) -> dict[str, Any]:
    return {
        "suite": BRIDGE,
        "name": f"widowx_{name}",
        "family": "put_on",
        "instruction": instruction,
        "robot": WIDOWX,
        "max_steps": 60,
        "models": (source, target),
        "models_file": "info_bridge_custom_v0.json",
        "stage": BRIDGE_TABLE,
        "contact_offset": 0.005,
        "overlays": (_image("bridge_real_eval_1"),),
        "camera": BRIDGE_CAMERA,
        "lighting": TABLE_LIGHT,
        "success": success,
        **fields,
    }


_COKE, _PICK_COKE = ("opened_coke_can",), "pick coke can"
ROWS: tuple[dict[str, Any], ...] = (
    _pick("pick_coke_can", _PICK_COKE, _COKE),
    _pick("pick_horizontal_coke_can", _PICK_COKE, _COKE, "lr_switch"),
    _pick("pick_vertical_coke_can", _PICK_COKE, _COKE, "laid_vertically"),
    _pick("pick_standing_coke_can", _PICK_COKE, _COKE, "upright"),
    _pick("pick_object", "pick OBJECT", PICK_MODELS),
    _move_near("move_near_v0", 0),
    _move_near("move_near_v1", 1),
    _move_near("move_near", 1),
    *(_drawer(verb, which) for verb in ("open", "close") for which in (None, *DRAWERS)),
    _place("in_closed_drawer", None),
    *(_place(f"in_closed_{which}_drawer", which) for which in DRAWERS),
    _place("apple_in_closed_top_drawer", "top", ("baked_apple_v2",)),
    _put_on(
        "spoon_on_towel",
        "put the spoon on the towel",
        "bridge_spoon_generated_modified",
        "table_cloth_generated_shorter",
        PutOnSuccess(),
    ),
    _put_on(
        "carrot_on_plate",
        "put carrot on plate",
        "bridge_carrot_generated_modified",
        "bridge_plate_objaverse_larger",
        PutOnSuccess(clear=True),
    ),
    _put_on(
        "stack_cube",
        "stack the green block on the yellow block",
        "baked_green_cube_3cm",
        "baked_yellow_cube_3cm",
        PutOnSuccess(clear=True),
        models_file="info_bridge_custom_baked_tex_v0.json",
    ),
    _put_on(
        "put_eggplant_in_basket",
        "put eggplant into yellow basket",
        "eggplant",
        "dummy_sink_target_plane",
        PutOnSuccess(z_slack=0.06),
        max_steps=120,
        stage=SINK_TABLE,
        overlays=(_image("bridge_sink"),),
        always_overlaid=("sink", "dummy_sink_target_plane"),
        camera=SINK_CAMERA,
        lighting=SINK_LIGHT,
    ),
)
