"""Variants of SIMPLER's Google Robot scenes: another light, cabinet, table or room, a turned camera, more objects.

In: a ``Variant`` and an episode's task and layout. Out: both, changed (``varied``). The values are those of upstream's
variant aggregation (SimplerEnv commit 4ab7178, ``scripts/*_variant_agg.sh``; ManiSkill2_real2sim commit ef7a4d4). With
``make(variant=...)`` they are put on episodes that seeds decide, where ``overlay="none"`` belongs to most of them;
upstream's own episodes, on grids of robot and object positions, are ``make(protocol="variant-aggregation")``
(``published/lists.py``).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from vecenv.assets import AssetsMissing
from vecenv.errors import InvalidInput
from vecenv.simpler.assets.files import NAME, how_to_get
from vecenv.simpler.layouts import Layout, Placed
from vecenv.simpler.task_spec import DATA, DirectionalLight, Lighting, SimplerTask, StageSpec

_ON_TABLE, _AT_CABINET = ("pick", "move_near"), ("open", "close", "place")
_GOOGLE_FAMILIES = (*_ON_TABLE, *_AT_CABINET)
_COKE = "opened_coke_can"
_AMBIENT = (0.3, 0.3, 0.3)


_T = TypeVar("_T")


class VariantError(InvalidInput):
    """A variant that does not exist or does not fit a task; the message says what does."""


def _sun(x: float, y: float, z: float, brightness: float, shadow: bool = False) -> DirectionalLight:
    return DirectionalLight(direction=(x, y, z), colour=(brightness, brightness, brightness), shadow=shadow)


def _room(brightness: float) -> Lighting:
    sides = (_sun(-1, 1, -0.05, 0.5), _sun(-1, -1, -0.05, 0.5))
    return Lighting(ambient=_AMBIENT, directional=(_sun(-0.2, 0, -1, brightness, shadow=True), *sides), casts=True)


TABLE_LIGHTS: Mapping[str, Lighting] = MappingProxyType(
    {
        "brighter": Lighting(
            ambient=_AMBIENT,
            directional=(_sun(0, 0, -1, 3.6, shadow=True), _sun(-1, -0.5, -1, 1.3), _sun(1, 1, -1, 1.3)),
        ),
        "darker": Lighting(ambient=_AMBIENT, directional=(_sun(1, 1, -1, 0.8, shadow=True), _sun(0, 0, -1, 0.8))),
    }
)
"""Light of ``pick`` and ``move_near``."""
CABINET_LIGHTS: Mapping[str, Lighting] = MappingProxyType(
    {"room": _room(1.0), "brighter": _room(2.0), "darker": _room(0.5)}
)
"""Light of ``open``, ``close`` and ``place``; ``room`` is variant aggregation's own, the others vary that. It casts
shadows, as upstream's does."""
STATIONS = ("mk_station", "mk_station2", "mk_station3", "mk_station4")
"""Cabinets beside visual matching's ``mk_station_recolor``."""
STAGES = (
    "Baked_sc1_staging_objaverse_cabinet1_h870",
    "Baked_sc1_staging_objaverse_cabinet2_h870",
    "google_pick_coke_can_1_v4_alt_background",
    "google_pick_coke_can_1_v4_alt_background_2",
)
"""Tables and rooms of ``pick`` and ``move_near``; ``vecenv assets pull simpler-variants`` fetches their files."""
CAMERAS: Mapping[str, float] = MappingProxyType({"lower": 0.9351361, "higher": 0.6651361})
"""Tilt of the head, radians; 0.7851361 otherwise."""
DISTRACTORS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "less": ("opened_pepsi_can", "apple", "sponge", "orange"),
        "more": (
            "opened_7up_can",
            "opened_sprite_can",
            "sponge",
            "orange",
            "opened_fanta_can",
            "bridge_spoon_generated_modified",
        ),
    }
)
"""Objects beside the coke can."""
# They lie at most this far from the can along an axis, within these corners, and further than this from it; metres.
_SPREAD, _CORNERS, _APART = 0.3, ((-0.50, 0.05), (-0.1, 0.35)), 0.25


@dataclass(frozen=True, kw_only=True)
class Variant:
    """What is different; None leaves it as visual matching has it.

    Attributes:
        lighting: ``"brighter"`` or ``"darker"``; at cabinets also ``"room"``.
        camera: ``"lower"`` or ``"higher"``: where the head looks.
        station: the cabinet, one of ``STATIONS``.
        stage: table and room around ``pick`` and ``move_near``, one of ``STAGES``, where the file is there.
        distractors: ``"less"`` or ``"more"`` objects beside the coke can; ``"none"`` leaves out ``move_near``'s third.
    """

    lighting: str | None = None
    camera: str | None = None
    station: str | None = None
    stage: str | None = None
    distractors: str | None = None


def make_variant(given: Variant | Mapping[str, str | None] | None) -> Variant | None:
    """A variant as it is, or of a mapping of its fields.

    Raises:
        VariantError: not a field, or not text.
    """
    if given is None or isinstance(given, Variant):
        return given
    known = [field.name for field in fields(Variant)]
    strange = [name for name in given if name not in known]
    if strange:
        raise VariantError(f"variant: {strange[0]!r} is not one of {', '.join(known)}")
    return Variant(**given)


def varied(task: SimplerTask, layout: Layout, variant: Variant | None) -> tuple[SimplerTask, Layout]:
    """An episode's task and layout under a variant.

    Raises:
        VariantError: the variant does not apply to this task; the message lists those that do.
    """
    if variant is None or variant == Variant():
        return task, layout
    if task.family not in _GOOGLE_FAMILIES:
        raise VariantError(f"variant: {task.name} has none, upstream varies the Google Robot's scenes only")
    changed = replace(task, **_task_changes(task, variant))
    return changed, _with_objects(changed, _with_camera(layout, variant), variant)


def station_meshes(station: PurePosixPath, root: Path) -> tuple[PurePosixPath, ...]:
    """Meshes that a cabinet of the asset tree is drawn with, paths in the tree; some of upstream's cabinets have one.

    Raises:
        AssetsMissing: there is no such cabinet; the message names the file.
    """
    if not (root / station).is_file():
        raise AssetsMissing(NAME, f"{root} has no {station}", how_to_get(station))
    tree = ET.parse(root / station)  # nosec B314 # a file of the asset tree
    names = (mesh.attrib["filename"] for mesh in tree.iter("mesh"))
    return tuple(station.parent / name for name in dict.fromkeys(names))


def _task_changes(task: SimplerTask, variant: Variant) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    cabinet = task.family in _AT_CABINET
    if variant.lighting is not None:
        changes["lighting"] = _chosen(task, "lighting", variant.lighting, CABINET_LIGHTS if cabinet else TABLE_LIGHTS)
    if variant.station is not None:
        name = _chosen(task, "station", variant.station, {each: each for each in STATIONS if cabinet})
        changes["station"] = DATA / f"custom/{name}.urdf"
    if variant.stage is not None:
        name = _chosen(task, "stage", variant.stage, {} if cabinet else {each: each for each in STAGES})
        changes["stage"] = StageSpec(name=name, offset=task.stage.offset, table_height=task.stage.table_height)
    return changes


def _chosen(task: SimplerTask, what: str, value: str, known: Mapping[str, _T]) -> _T:
    if value not in known:
        there = f"one of {', '.join(known)}" if known else "none at all"
        raise VariantError(f"variant: {what}={value!r} is not available for {task.name}; expected {there}")
    return known[value]


def _with_camera(layout: Layout, variant: Variant) -> Layout:
    if variant.camera is None:
        return layout
    if variant.camera not in CAMERAS:
        raise VariantError(f"variant: camera={variant.camera!r}: expected one of {', '.join(CAMERAS)}")
    return replace(layout, qpos=(*layout.qpos[:-1], CAMERAS[variant.camera]))


def _with_objects(task: SimplerTask, layout: Layout, variant: Variant) -> Layout:
    if variant.distractors is None:
        return layout
    can = task.family == "pick" and task.models == (_COKE,)
    known = tuple(DISTRACTORS) if can else ("none",) if task.family == "move_near" else ()
    _chosen(task, "distractors", variant.distractors, {each: each for each in known})
    if not can:
        return replace(layout, objects=(*layout.with_role("source"), *layout.with_role("target")))
    return replace(layout, objects=(*layout.objects, *_beside(layout, DISTRACTORS[variant.distractors])))


def _beside(layout: Layout, models: tuple[str, ...]) -> list[Placed]:
    """Distractors, drawn as upstream does: from the stream that the can's place came from, if that was drawn."""
    can = layout.objects[0]
    rng, middle = np.random.RandomState(layout.seed), np.array(can.position[:2])
    if layout.drawn:
        rng.uniform(size=2)
    found = []
    for model in models:
        place = middle
        while np.linalg.norm(place - middle) <= _APART:
            place = np.clip(middle + rng.uniform(-_SPREAD, _SPREAD, [2]), *_CORNERS)
        position = (float(place[0]), float(place[1]), can.position[2])
        found.append(Placed(model=model, role="distractor", position=position, quat=can.quat))
    return found
