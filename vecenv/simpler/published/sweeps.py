"""The sweeps of upstream's scripts, loop by loop: the episodes of visual matching and of variant aggregation.

In: a task. Out: its ``EpisodeSpec``s in the order in which the scripts (SimplerEnv commit 4ab7178, ``scripts/``) run
them for one checkpoint; ``lists.py`` numbers them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from vecenv.simpler.layouts import num_arrangements, unseeded_seeds
from vecenv.simpler.published.specs import (
    COKE_ENVIRONMENT,
    MOVE_NEAR_ENVIRONMENT,
    VARIANT_AGGREGATION,
    VISUAL_MATCHING,
    BuildKwargs,
    EpisodeSpec,
    common_fields,
)
from vecenv.simpler.stations import DRAWER_STATIONS, MOVE_NEAR_STATION, PICK_STATION, Station, put_on_station, stand
from vecenv.simpler.task_spec import SimplerTask

# ---------------------------------------------------------------------------------------------------------------------
# Grids.

_PLAIN, _TABLETOP_1, _TABLETOP_2, _CABINET = (
    "",
    "recolor_tabletop_visual_matching_1",
    "recolor_tabletop_visual_matching_2",
    "recolor_cabinet_visual_matching_1",
)
_TABLE_COLOURS = (_PLAIN, _TABLETOP_1, _TABLETOP_2, _CABINET)
_CABINET_COLOURS = (_CABINET, _TABLETOP_1, _TABLETOP_2, _PLAIN)
# What a script writes for the robot's own colours.
_NO_VERSION = "None"
_ORIENTATIONS = ("lr_switch", "upright", "laid_vertically")
_Range = tuple[float, float, int]


def _grid(xs: _Range, ys: _Range) -> tuple[tuple[float, float], ...]:
    """Points row by row: lowest, highest and number of x, and of y, metres."""
    return tuple((float(x), float(y)) for x in np.linspace(*xs) for y in np.linspace(*ys))


_CAN_PLACES = _grid((-0.35, -0.12, 5), (-0.02, 0.42, 5))
_APPLE_PLACES = _grid((-0.08, -0.02, 3), (-0.02, 0.08, 3))
_DRAWER_GRID = tuple((x, y, 0.0) for x, y in _grid((0.65, 0.85, 3), (-0.2, 0.2, 3)))
_APPLE_GRID = tuple((x, y, 0.0) for x, y in _grid((0.65, 0.65, 1), (-0.2, 0.2, 3)))
# Upstream makes a new environment for every episode and resets it once without a seed.
_LIST_SEED = unseeded_seeds(1)[0]


def _listed(station: Station) -> dict[str, Any]:
    """Fields of a row of a list that says where the robot stands."""
    return {"seed": _LIST_SEED, "drawn": False, **stand(station)}


def _orientations(task: SimplerTask) -> tuple[str, ...]:
    return _ORIENTATIONS if task.orientation is None else (task.orientation,)


# ---------------------------------------------------------------------------------------------------------------------
# Visual matching.


def _match_put_on(task: SimplerTask) -> Iterator[EpisodeSpec]:
    common = common_fields(task, VISUAL_MATCHING, "scripts/octo_bridge.sh") | _listed(put_on_station(task))
    for number in range(num_arrangements(task)):
        yield EpisodeSpec(**common, overlay=task.overlays[0], episode_id=number)


def _match_pick(task: SimplerTask) -> Iterator[EpisodeSpec]:
    common = common_fields(task, VISUAL_MATCHING, "scripts/rt1_pick_coke_can_visual_matching.sh") | _listed(
        PICK_STATION
    )
    for version, lies, xy in itertools.product(_TABLE_COLOURS, _orientations(task), _CAN_PLACES):
        yield EpisodeSpec(
            **common,
            urdf_version=version,
            overlay=task.overlays[0],
            model=task.models[0],
            object_xy=xy,
            orientation=lies,
            build_kwargs=((lies, True), ("urdf_version", version or _NO_VERSION)),
        )


def _match_move_near(task: SimplerTask) -> Iterator[EpisodeSpec]:
    common = common_fields(task, VISUAL_MATCHING, "scripts/rt1_move_near_visual_matching.sh") | _listed(
        MOVE_NEAR_STATION
    )
    for version, number in itertools.product(_TABLE_COLOURS, range(num_arrangements(task))):
        kwargs = (("urdf_version", version or _NO_VERSION),)
        yield EpisodeSpec(
            **common, urdf_version=version, overlay=task.overlays[0], episode_id=number, build_kwargs=kwargs
        )


def _station_kwargs(version: str) -> BuildKwargs:
    """Of visual matching's cabinets."""
    return (
        ("shader_dir", "rt"),
        ("station_name", "mk_station_recolor"),
        ("light_mode", "simple"),
        ("disable_bad_material", True),
        ("urdf_version", version or _NO_VERSION),
    )


def _match_drawer(task: SimplerTask) -> Iterator[EpisodeSpec]:
    for version, drawer, overlay in itertools.product(_CABINET_COLOURS, task.drawers, task.overlays):
        yield EpisodeSpec(
            **common_fields(task, VISUAL_MATCHING, "scripts/rt1_drawer_visual_matching.sh", drawer),
            **_listed(DRAWER_STATIONS[overlay.stem[-2:]]),
            urdf_version=version,
            overlay=overlay,
            drawer=drawer,
            build_kwargs=_station_kwargs(version),
        )


def _match_place(task: SimplerTask) -> Iterator[EpisodeSpec]:
    (model,), (drawer,) = task.models, task.drawers
    for version, overlay, xy in itertools.product(_CABINET_COLOURS, task.overlays, _APPLE_PLACES):
        yield EpisodeSpec(
            **common_fields(task, VISUAL_MATCHING, "scripts/rt1_put_in_drawer_visual_matching.sh"),
            **_listed(DRAWER_STATIONS[overlay.stem[-2:]]),
            urdf_version=version,
            overlay=overlay,
            model=model,
            object_xy=xy,
            drawer=drawer,
            build_kwargs=(*_station_kwargs(version), ("model_ids", model)),
        )


# ---------------------------------------------------------------------------------------------------------------------
# Variant aggregation: settings in groups; within a group the script's orientations or drawers come first.


@dataclass(frozen=True, kw_only=True)
class _Setting:
    """One setting of a sweep: its kind, fields of the ``EpisodeSpec``, and what the script passes for it."""

    kind: str = "base"
    changes: Mapping[str, str]
    kwargs: BuildKwargs = ()

    def fields(self) -> dict[str, Any]:
        """Fields of the ``EpisodeSpec`` that say so."""
        return {**self.changes, "setting": self.kind, "averaged": self.kind != "camera"}


_Groups = tuple[tuple[_Setting, ...], ...]
_BASE = (_Setting(changes={}),)
_TABLES = tuple(
    _Setting(kind="table", changes={"scene": f"Baked_sc1_staging_objaverse_cabinet{number}_h870"}) for number in (1, 2)
)
_BACKGROUNDS = tuple(
    _Setting(kind="background", changes={"scene": f"google_pick_coke_can_1_v4_alt_background{suffix}"})
    for suffix in ("", "_2")
)
_LIGHTS = tuple(
    _Setting(kind="lighting", changes={"lighting": light}, kwargs=((f"slightly_{light}_lighting", True),))
    for light in ("darker", "brighter")
)
_CAN_CROWDS = tuple(
    _Setting(
        kind="distractors",
        changes={"distractors": crowd, "environment": COKE_ENVIRONMENT.format("Distractor")},
        kwargs=kwargs,
    )
    for crowd, kwargs in (("less", ()), ("more", (("distractor_config", "more"),)))
)


def _cameras(environment: str, name: str) -> tuple[_Setting, ...]:
    return tuple(
        _Setting(kind="camera", changes={"camera": camera, "environment": environment.format(f"{name}{suffix}")})
        for camera, suffix in (("lower", ""), ("higher", "2"))
    )


_CAN_GROUPS: _Groups = (
    _BASE,
    _TABLES,
    _CAN_CROWDS,
    _BACKGROUNDS,
    _LIGHTS,
    _cameras(COKE_ENVIRONMENT, "AltGoogleCamera"),
)
_ALONE = _Setting(kind="distractors", changes={"distractors": "none"}, kwargs=(("no_distractor", True),))
_NEAR_GROUPS: _Groups = (
    _BASE,
    (_ALONE,),
    _BACKGROUNDS,
    _LIGHTS,
    _TABLES,
    _cameras(MOVE_NEAR_ENVIRONMENT, "AltGoogleCamera"),
)
_ROOM_LIGHTS = tuple(
    _Setting(kind="lighting", changes={"lighting": light}, kwargs=(("light_mode", light),))
    for light in ("brighter", "darker")
)
_CABINETS = tuple(
    _Setting(kind="cabinet", changes={"station": station}, kwargs=(("station_name", station),))
    for station in ("mk_station2", "mk_station3")
)
_CABINET_GROUPS: _Groups = (
    _BASE,
    *(
        (_Setting(kind="background", changes={"scene": scene}),)
        for scene in ("modern_bedroom_no_roof", "modern_office_no_roof")
    ),
    _ROOM_LIGHTS,
    _CABINETS,
)


def _sweep(groups: _Groups, heads: Iterable[str]) -> Iterator[tuple[str, _Setting]]:
    """A script's loops: its groups of settings, in each its orientations or drawers, for each the settings."""
    heads = tuple(heads)
    for group in groups:
        yield from itertools.product(heads, group)


def _vary_pick(task: SimplerTask) -> Iterator[EpisodeSpec]:
    common = common_fields(task, VARIANT_AGGREGATION, "scripts/rt1_pick_coke_can_variant_agg.sh") | _listed(
        PICK_STATION
    )
    for lies, setting in _sweep(_CAN_GROUPS, _orientations(task)):
        for xy in _CAN_PLACES:
            yield EpisodeSpec(
                **(common | setting.fields()),
                model=task.models[0],
                object_xy=xy,
                orientation=lies,
                build_kwargs=((lies, True), *setting.kwargs),
            )


def _vary_move_near(task: SimplerTask) -> Iterator[EpisodeSpec]:
    common = common_fields(task, VARIANT_AGGREGATION, "scripts/rt1_move_near_variant_agg.sh") | _listed(
        MOVE_NEAR_STATION
    )
    common["environment"] = MOVE_NEAR_ENVIRONMENT.format("Google")
    for _, setting in _sweep(_NEAR_GROUPS, ("",)):
        for number in range(num_arrangements(task)):
            yield EpisodeSpec(**(common | setting.fields()), episode_id=number, build_kwargs=setting.kwargs)


_ROOM: Mapping[str, Any] = MappingProxyType(
    {"scene": "frl_apartment_stage_simple", "station": "mk_station", "lighting": "room"}
)


def _vary_drawer(task: SimplerTask) -> Iterator[EpisodeSpec]:
    for drawer, setting in _sweep(_CABINET_GROUPS, task.drawers):
        common = common_fields(task, VARIANT_AGGREGATION, "scripts/rt1_drawer_variant_agg.sh", drawer)
        for station in _DRAWER_GRID:
            yield EpisodeSpec(
                **(common | _listed(station) | dict(_ROOM) | setting.fields()),
                drawer=drawer,
                build_kwargs=(("shader_dir", "rt"), *setting.kwargs),
            )


def _vary_place(task: SimplerTask) -> Iterator[EpisodeSpec]:
    (drawer,), model = task.drawers, "apple"
    common = common_fields(task, VARIANT_AGGREGATION, "scripts/rt1_put_in_drawer_variant_agg.sh")
    for _, setting in _sweep(_CABINET_GROUPS, ("",)):
        for station, xy in itertools.product(_APPLE_GRID, _APPLE_PLACES):
            yield EpisodeSpec(
                **(common | _listed(station) | dict(_ROOM) | setting.fields()),
                model=model,
                object_xy=xy,
                drawer=drawer,
                build_kwargs=(("shader_dir", "rt"), *setting.kwargs, ("model_ids", model)),
            )


def _vary_nothing(task: SimplerTask) -> Iterator[EpisodeSpec]:
    """Upstream varies the Google Robot's scenes only."""
    del task
    return iter(())


MATCHING = MappingProxyType(
    {
        "put_on": _match_put_on,
        "pick": _match_pick,
        "move_near": _match_move_near,
        "open": _match_drawer,
        "close": _match_drawer,
        "place": _match_place,
    }
)
AGGREGATION = MappingProxyType(
    {
        "put_on": _vary_nothing,
        "pick": _vary_pick,
        "move_near": _vary_move_near,
        "open": _vary_drawer,
        "close": _vary_drawer,
        "place": _vary_place,
    }
)
