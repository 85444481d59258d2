"""SIMPLER's published evaluation lists: every episode that upstream's scripts run, as data.

In: a protocol and a task's name. Out: ``episodes``, one ``EpisodeSpec`` an episode, in the order of upstream's loops;
and ``scene_of``, the task and layout that a spec leads to. Read from SimplerEnv commit 4ab7178 (``scripts/``,
``simpler_env/evaluation``) and ManiSkill2_real2sim commit ef7a4d4 (``envs/custom_scenes``). Needs neither SAPIEN nor
assets. Episodes of a task, with the script they were counted in (its loop over checkpoints left out):

===================================== ================ =================== ===========================================
task                                  visual-matching  variant-aggregation script
===================================== ================ =================== ===========================================
widowx, each of the four              24                0                  octo_bridge.sh, rt1x_bridge.sh
pick_coke_can                         4 x 3 x 25 = 300 11 x 3 x 25 = 825   rt1_pick_coke_can_visual_matching.sh,
                                                                           rt1_pick_coke_can_variant_agg.sh
pick_horizontal, _vertical, _standing 4 x 25 = 100     11 x 25 = 275       the same, one of three orientations
move_near, _v0, _v1                   4 x 60 = 240     10 x 60 = 600       rt1_move_near_visual_matching.sh,
                                                                           rt1_move_near_variant_agg.sh
open_drawer, close_drawer             4 x 3 x 9 = 108  7 x 3 x 9 = 189     rt1_drawer_visual_matching.sh,
                                                                           rt1_drawer_variant_agg.sh
open_.._drawer, close_.._drawer       4 x 9 = 36       7 x 9 = 63          the same, one of three drawers
place_apple_in_closed_top_drawer      4 x 3 x 9 = 108  7 x 3 x 9 = 189     rt1_put_in_drawer_visual_matching.sh,
                                                                           rt1_put_in_drawer_variant_agg.sh
pick_object, other place_in_closed_.. 10               0                   simple_inference_visual_matching_..._envs.py
===================================== ================ =================== ===========================================

Visual matching's 4 are the robot's colours; variant aggregation's 11, 10 and 7 are settings of the scene. The scripts
for Octo run the same episodes (visual matching's cans at 501 physics steps a second instead of 513).
``move_near_v0`` is what the script runs, ``move_near_v1`` the alternative that it names in a comment, and ``move_near``
is that too; in variant aggregation all three are the one environment that the script runs. Tasks without a sweep of
their own have what the script for prepackaged environments runs by default: ten resets in a row.
"""

from __future__ import annotations

import difflib
import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from vecenv.placement import Placement, PlacementError, cross, each_read_once, episode_indices, integers
from vecenv.protocols import ProtocolError
from vecenv.simpler.layouts import Choices, Layout, drawn, episode_seed, lay_out, unseeded_seeds
from vecenv.simpler.published.specs import (
    PROTOCOLS,
    SEED,
    VARIANT_AGGREGATION,
    VISUAL_MATCHING,
    BuildKwargs,
    EpisodeSpec,
    common_fields,
)
from vecenv.simpler.published.sweeps import AGGREGATION, MATCHING
from vecenv.simpler.task_spec import SimplerTask, StageSpec
from vecenv.simpler.task_table import COKE_TABLE, PLAIN_MODELS_FILE, PLAIN_TRIPLETS
from vecenv.simpler.tasks import NUM_EPISODES, TASKS, UnknownTask, list_tasks
from vecenv.simpler.variants import varied

__all__ = [
    "PROTOCOLS",
    "ROOMS",
    "SEED",
    "VARIANT_AGGREGATION",
    "VISUAL_MATCHING",
    "EpisodeSpec",
    "PublishedError",
    "check_placement",
    "check_protocol",
    "counts",
    "episodes",
    "num_episodes",
    "place",
    "scene_of",
]


class PublishedError(ProtocolError):
    """A protocol that does not exist, or a task without episodes under it; the message lists those that exist."""


def episodes(protocol: str, task: str) -> Sequence[EpisodeSpec]:
    """The episodes of a task under a protocol; episode e is row e.

    Args:
        protocol: one of ``PROTOCOLS``.
        task: one of ``TASKS``.

    Raises:
        PublishedError: no such protocol, or upstream has no episodes of this task under it.
        UnknownTask: no such task.
    """
    return _checked(protocol, task)


def _checked(protocol: str, task: str) -> tuple[EpisodeSpec, ...]:
    rows = _rows(check_protocol(protocol), _task(task).name)
    if not rows:
        there = ", ".join(name for name in TASKS if _rows(protocol, name))
        raise PublishedError(f"protocol {protocol!r} has no episodes of {task}; it has some of {there}")
    return rows


def check_protocol(protocol: str) -> str:
    """The protocol, if it exists.

    Raises:
        PublishedError: it does not.
    """
    if protocol not in PROTOCOLS:
        raise PublishedError(f"protocol={protocol!r} is not available; available: {', '.join(PROTOCOLS)}")
    return protocol


def counts(protocol: str, suite: str) -> dict[int, int]:
    """Index of a task -> how many episodes a protocol has of it, for the tasks of a suite that it has episodes of.

    Raises:
        PublishedError: no such protocol, or it has no episodes of this suite.
        UnknownSuite: no such suite.
    """
    found = {task.index: num_episodes(protocol, task.name) for task in list_tasks(suite)}
    if not any(found.values()):
        raise PublishedError(
            f"protocol {protocol!r} has no episodes of {suite}: upstream varies the Google Robot's scenes only"
        )
    return {index: count for index, count in found.items() if count}


def place(protocol: str, suite: str, tasks: object, episodes: object) -> Placement:
    """Every chosen episode of every chosen task, task by task.

    Args:
        protocol: one of ``PROTOCOLS``.
        suite: the suite.
        tasks: one index or several; None for every task that the protocol has episodes of.
        episodes: as for ``placement.cross``; None for all that the protocol has of a task.

    Raises:
        PublishedError: a task that the protocol has no episodes of.
        PlacementError: a task or an episode that does not exist, or nothing to place.
    """
    there, names = counts(protocol, suite), [task.name for task in list_tasks(suite)]
    listed = list(there) if tasks is None else integers(tasks, "task")
    if not listed:
        raise PlacementError("no slot to fill: tasks or episodes are empty")
    chosen = cross(listed, [0], num_tasks=len(names), num_episodes=1).task.tolist()
    episodes = each_read_once(episodes, chosen)
    parts = []
    for task in chosen:
        count = len(_checked(protocol, names[task]))
        wanted = episodes.get(task, ()) if isinstance(episodes, Mapping) else episodes
        indices = range(count) if wanted is None else episode_indices(wanted, count)
        if len(indices):
            parts.append(cross([task], indices, num_tasks=len(names), num_episodes=count))
    if not parts:
        raise PlacementError("no slot to fill: tasks or episodes are empty")
    columns = [np.concatenate([getattr(part, column) for part in parts]) for column in ("task", "episode")]
    return Placement(*columns)


def check_placement(protocol: str, suite: str, placement: Placement) -> Placement:
    """A placement whose episodes all exist; errors as of ``place``."""
    for task, episode in zip(placement.task.tolist(), placement.episode.tolist(), strict=True):
        place(protocol, suite, task, [episode])
    return placement


def num_episodes(protocol: str, task: str) -> int:
    """Number of episodes of a task under a protocol, 0 if upstream has none; errors as of ``episodes``."""
    return len(_rows(check_protocol(protocol), _task(task).name))


def _task(name: str) -> SimplerTask:
    if name not in TASKS:
        near = difflib.get_close_matches(str(name), TASKS, n=3) or list(TASKS)
        raise UnknownTask(f"SIMPLER has no task {name!r}: did you mean {', '.join(near)}?")
    return TASKS[name]


@functools.cache
def _rows(protocol: str, name: str) -> tuple[EpisodeSpec, ...]:
    task = TASKS[name]
    if protocol == SEED:
        rows = _seeded(task)
    else:
        sweeps = MATCHING if protocol == VISUAL_MATCHING else AGGREGATION
        rows = sweeps[task.family](task) if _is_swept(task) else _prepackaged(task, protocol)
    return tuple(replace(row, index=index) for index, row in enumerate(rows))


def _is_swept(task: SimplerTask) -> bool:
    """Whether one of upstream's sweeps runs it."""
    return task.family not in ("pick", "place") or len(task.models) == 1


# ---------------------------------------------------------------------------------------------------------------------
# Rows that a seed decides.


def _seeded(task: SimplerTask) -> Iterator[EpisodeSpec]:
    script = "simpler_env/__init__.py"
    for episode in range(NUM_EPISODES):
        yield _of_choices(task, SEED, script, drawn(task, episode_seed(episode)))


_NUM_PREPACKAGED = 10


def _prepackaged(task: SimplerTask, protocol: str) -> Iterator[EpisodeSpec]:
    """Upstream's default: so many resets without a seed in a new environment. It varies nothing."""
    script = "simpler_env/simple_inference_visual_matching_prepackaged_envs.py"
    for seed in unseeded_seeds(_NUM_PREPACKAGED) if protocol == VISUAL_MATCHING else ():
        yield _of_choices(task, protocol, script, drawn(task, seed))


def _of_choices(task: SimplerTask, protocol: str, source: str, choices: Choices) -> EpisodeSpec:
    made = {field.name: getattr(choices, field.name) for field in fields(Choices)}
    kwargs: BuildKwargs = (("prepackaged_config", True),)
    if task.orientation:
        kwargs = ((task.orientation, True), *kwargs)
    if task.family == "place" and len(task.models) == 1:
        kwargs = (("model_ids", task.models[0]), *kwargs)
    return EpisodeSpec(**common_fields(task, protocol, source), **made, build_kwargs=kwargs)


# ---------------------------------------------------------------------------------------------------------------------
# From a spec to a scene.

_GOOGLE_OFFSET = COKE_TABLE.offset


def _room(name: str, turn: tuple[float, ...] = COKE_TABLE.turn) -> StageSpec:
    return StageSpec(name=name, offset=_GOOGLE_OFFSET, turn=turn, solid=False)


# Upstream turns and shifts two of them: a pose times the quaternion (0.707, 0.707, 0, 0), which puts a mesh upright.
ROOMS: Mapping[str, StageSpec] = MappingProxyType(
    {
        "frl_apartment_stage_simple": _room("frl_apartment_stage_simple"),
        "modern_bedroom_no_roof": _room(
            "modern_bedroom_no_roof", (0.178, -2.235, 1.669, 0.004949, 0.004949, -0.707, -0.707)
        ),
        "modern_office_no_roof": _room(
            "modern_office_no_roof", (-0.192, -1.728, 1.48, 0.501263, 0.501263, -0.498435, -0.498435)
        ),
    }
)
"""Rooms around variant aggregation's cabinets; they are rendered and have no collision shapes."""


def scene_of(spec: EpisodeSpec) -> tuple[SimplerTask, Layout]:
    """The task with the changes of the episode, and the layout."""
    task = replace(TASKS[spec.task], max_steps=spec.max_steps)
    if spec.protocol == VARIANT_AGGREGATION:
        task = _aggregated(task, spec)
    return varied(task, lay_out(task, spec), spec.variant)


def _aggregated(task: SimplerTask, spec: EpisodeSpec) -> SimplerTask:
    """Objects and materials of variant aggregation, and the room around a cabinet."""
    changes: dict[str, Any] = {"shiny": True, "matte": False}
    if task.family == "move_near":
        changes |= {"triplets": PLAIN_TRIPLETS, "models_file": PLAIN_MODELS_FILE}
    if task.family == "place":
        changes["models"] = (spec.model,)
    if task.station is not None:
        changes["stage"] = ROOMS[spec.scene]
    return replace(task, **changes)
