"""What an episode of SIMPLER consists of: objects, where they are dropped, where the robot stands, the instruction.

In: a task and its ``Choices``: the robot's place, the object's, the drawer, the arrangement. They are drawn from a seed
(``drawn``) or come from a published list (``published/lists.py``). Out: a ``Layout`` (``lay_out``). Draws use NumPy's
``RandomState`` alone, draw for draw as upstream does it (ManiSkill2_real2sim commit ef7a4d4, ``envs/custom_scenes``).
Each class of upstream's hierarchy starts the episode's stream anew, so draws of different layers are made from equal
streams: that is why several functions begin with a fresh ``RandomState(seed)``. Objects are given where they are
dropped, half a metre above the table; the simulator lets them settle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Required, TypedDict

import numpy as np

from vecenv.errors import InvalidInput
from vecenv.simpler.stations import (
    DRAWER_STATIONS,
    MOVE_NEAR_STATION,
    PICK_STATION,
    Quat,
    at_sink,
    first_posture,
    multiply_quats,
    put_on_station,
    roll_quat,
    stand,
    yaw_quat,
)
from vecenv.simpler.task_spec import DRAWERS, ORIENTATIONS, SimplerTask
from vecenv.simpler.tasks import FIRST_SEED, NUM_EPISODES

Vector = tuple[float, float, float]
_UPRIGHT: Quat = (1.0, 0.0, 0.0, 0.0)
DROP_HEIGHT = 0.5
"""Metres above the table from which objects are dropped."""

SINK = "sink"
_SINK_POSITION: Vector = (-0.16, 0.13, 0.88)
# Toy fruit weighs less than the models' files say; upstream overrides them in move_near only.
_LIGHT_FRUIT = ("apple", "baked_apple", "baked_apple_v2", "orange")
_LIGHT_DENSITY = 200.0


class LayoutError(InvalidInput):
    """A seed or episode that does not exist; the message says which do."""


@dataclass(frozen=True, kw_only=True)
class Choices:
    """What differs between the episodes of a task.

    Attributes:
        seed: of upstream's random stream.
        drawn: whether the seed decided all of this; of a list's episodes it decides only where distractors lie.
        robot_xy: where the robot's root link stands, metres, world frame.
        robot_quat: of the root link, wxyz.
        urdf_version: which of the robot's versions; "" is the plain one.
        overlay: image that replaces the background, in the asset tree; None where the drawn scene is shown.
        model: of ``pick`` and ``place``, the object.
        object_xy: of ``pick`` and ``place``, above which point the object is dropped, metres, world frame.
        orientation: of ``pick``, how the object lies: one of ``ORIENTATIONS``.
        episode_id: of ``move_near`` and ``put_on``, upstream's number of the arrangement.
        drawer: of ``open``, ``close`` and ``place``, the drawer: one of ``DRAWERS``.
    """

    seed: int
    drawn: bool = True
    robot_xy: tuple[float, float]
    robot_quat: Quat
    urdf_version: str = ""
    overlay: PurePosixPath | None = None
    model: str = ""
    object_xy: tuple[float, float] | None = None
    orientation: str = ""
    episode_id: int | None = None
    drawer: str = ""


@dataclass(frozen=True, kw_only=True)
class Placed:
    """An object at the beginning of an episode.

    Attributes:
        model: its name, also of its folder in the asset tree.
        role: ``source`` (the object to move), ``target``, ``other``, ``distractor`` (another object, dropped when the
            rest has settled), or ``fixture`` (does not move).
        position: metres, world frame; where it is dropped, or stands.
        quat: wxyz, world frame.
        density: kg/m³, where it is not the one of its file.
    """

    model: str
    role: str
    position: Vector
    quat: Quat
    density: float | None = None


@dataclass(frozen=True, kw_only=True)
class Layout:
    """One episode.

    Attributes:
        task: the task's name.
        seed: of upstream's random stream.
        drawn: whether everything was drawn from it; see ``Choices``.
        objects: in upstream's order.
        base_position: of the robot's root link, metres, world frame.
        base_quat: wxyz.
        qpos: the robot's joints, radians and metres, in the order of ``Robot.joints``.
        urdf_version: which of the robot's versions.
        overlay: image that replaces the background, in the asset tree; None where the drawn scene is shown.
        drawer: which drawer the task is about, "" when none.
        drawer_qpos: how far it is open at first, metres.
        instruction: the policy's instruction at first.
        second_instruction: its instruction in the second half of a ``place`` episode, else "".
        orientation: of ``pick``, how the object lies.
        episode_id: upstream's number of the arrangement, None if there is none.
    """

    task: str
    seed: int
    drawn: bool = True
    objects: tuple[Placed, ...]
    base_position: Vector
    base_quat: Quat
    qpos: tuple[float, ...]
    urdf_version: str = ""
    overlay: PurePosixPath | None
    drawer: str = ""
    drawer_qpos: float = 0.0
    instruction: str
    second_instruction: str = ""
    orientation: str = ""
    episode_id: int | None = None

    def with_role(self, role: str) -> tuple[Placed, ...]:
        """The objects of a role."""
        return tuple(placed for placed in self.objects if placed.role == role)


class _FamilyFields(TypedDict, total=False):
    """Fields of a ``Layout`` that depend on the task's family."""

    objects: Required[tuple[Placed, ...]]
    instruction: Required[str]
    second_instruction: str
    orientation: str
    episode_id: int
    drawer: str
    drawer_qpos: float


def episode_seed(episode: int) -> int:
    """Seed of an evaluation episode, 0 to 49.

    Raises:
        LayoutError: no such episode.
    """
    if not 0 <= episode < NUM_EPISODES:
        raise LayoutError(f"episode {episode} does not exist; there are {NUM_EPISODES} (0 to {NUM_EPISODES - 1})")
    return FIRST_SEED + episode


def unseeded_seeds(count: int) -> tuple[int, ...]:
    """Seeds of upstream's first ``count`` resets without a seed in a new environment: a chain that begins at 2022."""
    seeds, seed = [], 2022
    for _ in range(count):
        seed = int(np.random.RandomState(seed).randint(2**32, dtype=np.int64))
        seeds.append(seed)
    return tuple(seeds)


def episode_layout(task: SimplerTask, seed: int) -> Layout:
    """The episode that upstream's ``reset(seed=seed)`` sets up.

    Args:
        task: one of ``TASKS``.
        seed: 0 to 2³² - 1; ``episode_seed`` of an evaluation episode.

    Raises:
        LayoutError: the seed is out of range.
    """
    return lay_out(task, drawn(task, seed))


def drawn(task: SimplerTask, seed: int) -> Choices:
    """What upstream's ``reset(seed=seed)`` draws; arguments and errors as of ``episode_layout``."""
    if not 0 <= seed < 2**32:
        raise LayoutError(f"seed {seed} is not between 0 and 2**32 - 1")
    drawer = {"open": _draw_station, "close": _draw_station, "place": _draw_place}
    draws = {"pick": _draw_pick, "move_near": _draw_move_near, "put_on": _draw_put_on, **drawer}
    return draws[task.family](task, seed)


def lay_out(task: SimplerTask, choices: Choices) -> Layout:
    """The episode of a task that choices lead to.

    Raises:
        LayoutError: an arrangement, drawer or orientation that the task does not have.
    """
    drawer = {"open": _drawer, "close": _drawer, "place": _place}
    families = {"pick": _pick, "move_near": _move_near, "put_on": _put_on, **drawer}
    height, qpos = first_posture(task)
    return Layout(
        task=task.name,
        seed=choices.seed,
        drawn=choices.drawn,
        base_position=(*choices.robot_xy, height),
        base_quat=choices.robot_quat,
        qpos=qpos,
        urdf_version=choices.urdf_version,
        overlay=choices.overlay,
        **families[task.family](task, choices),
    )


def object_words(model: str) -> str:
    """An object's name as instructions say it: upstream's ``_get_instruction_obj_name``."""
    silent = {"opened", "light", "generated", "modified", "objaverse", "bridge", "baked", "v2"}
    return " ".join(word for word in model.split("_") if word not in silent and not word.endswith("cm"))


# ---------------------------------------------------------------------------------------------------------------------
# Families.


def _draw_pick(task: SimplerTask, seed: int) -> Choices:
    orientation = task.orientation or str(_stream(seed).choice(list(ORIENTATIONS)))
    rng = _stream(seed)
    model = _choice(task.models, rng)
    version = str(rng.choice(list(task.robot.versions)))
    x, y = _stream(seed).uniform([-0.35, -0.02], [-0.12, 0.42], [2])
    return Choices(
        seed=seed,
        **stand(PICK_STATION),
        urdf_version=version,
        overlay=task.overlays[0],
        model=model,
        object_xy=(float(x), float(y)),
        orientation=orientation,
    )


def _pick(task: SimplerTask, choices: Choices) -> _FamilyFields:
    turns = {
        "upright": roll_quat(math.pi / 2),
        "laid_vertically": yaw_quat(math.pi / 2),
        "lr_switch": yaw_quat(math.pi),
    }
    quat = turns[_known("orientation", choices.orientation, turns)]
    return {
        "objects": (_source(task, choices, quat),),
        "instruction": f"pick {object_words(choices.model)}",
        "orientation": choices.orientation,
    }


def _source(task: SimplerTask, choices: Choices, quat: Quat) -> Placed:
    if choices.object_xy is None or not choices.model:
        raise LayoutError(f"{task.name} needs an object and its place")
    return Placed(model=choices.model, role="source", position=_drop(task, *choices.object_xy), quat=quat)


_PAIRS = tuple(itertools.permutations(range(3), 2))
_TRIANGLES = (((-0.33, 0.04), (-0.33, 0.34), (-0.13, 0.19)), ((-0.13, 0.04), (-0.33, 0.19), (-0.13, 0.34)))
_PER_TRIPLET = len(_PAIRS) * len(_TRIANGLES)


def _draw_move_near(task: SimplerTask, seed: int) -> Choices:
    return Choices(
        seed=seed,
        **stand(MOVE_NEAR_STATION),
        urdf_version=str(_stream(seed).choice(list(task.robot.versions))),
        overlay=task.overlays[0],
        episode_id=int(_stream(seed).randint(num_arrangements(task))),
    )


def num_arrangements(task: SimplerTask) -> int:
    """How many numbers upstream gives to the arrangements of a task of ``move_near`` or ``put_on``; 0 for others."""
    if task.family == "put_on":
        places, turns = _put_on_choices(task.name)
        return len(places) * len(turns)
    return len(task.triplets) * _PER_TRIPLET


def _arrangement(task: SimplerTask, choices: Choices) -> int:
    number, count = choices.episode_id, num_arrangements(task)
    if number is None or not 0 <= number < count:
        raise LayoutError(f"{task.name} has no arrangement {number}; there are {count} (0 to {count - 1})")
    return number


def _move_near(task: SimplerTask, choices: Choices) -> _FamilyFields:
    episode = _arrangement(task, choices)
    triplet, corners = task.triplets[episode // _PER_TRIPLET], _TRIANGLES[episode % _PER_TRIPLET // len(_PAIRS)]
    source, target = _PAIRS[episode % len(_PAIRS)]
    roles = {source: "source", target: "target"}
    return {
        "objects": tuple(
            Placed(
                model=model,
                role=roles.get(i, "other"),
                position=_drop(task, *corners[i]),
                quat=_standing(model),
                density=_LIGHT_DENSITY if model in _LIGHT_FRUIT else None,
            )
            for i, model in enumerate(triplet)
        ),
        "instruction": f"move {object_words(triplet[source])} near {object_words(triplet[target])}",
        "episode_id": episode,
    }


def _standing(model: str) -> Quat:
    """How an object of ``move_near`` is put down: cans and bottles have their axis along y."""
    if "apple" in model:
        return _UPRIGHT
    if "can" in model.split("_"):
        return roll_quat(math.pi / 2)
    return multiply_quats(yaw_quat(math.pi / 2), roll_quat(math.pi / 2)) if "bottle" in model else yaw_quat(math.pi / 2)


def _draw_station(task: SimplerTask, seed: int) -> Choices:
    """Drawer, image and URDF version, drawn from one stream."""
    rng = _stream(seed)
    drawer = str(rng.choice(list(task.drawers)))
    overlay = task.overlays[int(rng.choice(len(task.overlays)))]
    station = DRAWER_STATIONS[overlay.stem.rsplit("_", 1)[-1]]
    version = str(rng.choice(list(task.robot.versions)))
    return Choices(seed=seed, **stand(station), urdf_version=version, overlay=overlay, drawer=drawer)


def _drawer(task: SimplerTask, choices: Choices) -> _FamilyFields:
    drawer = _known("drawer", choices.drawer, DRAWERS)
    return {
        "objects": (),
        "drawer": drawer,
        "drawer_qpos": getattr(task.success, "start", 0.0),
        "instruction": f"{task.family} {drawer} drawer",
    }


def _draw_place(task: SimplerTask, seed: int) -> Choices:
    model = _choice(task.models, _stream(seed))
    x, y = _stream(seed).uniform([-0.10, -0.00], [-0.05, 0.1], [2])
    return replace(_draw_station(task, seed), model=model, object_xy=(float(x), float(y)))


def _place(task: SimplerTask, choices: Choices) -> _FamilyFields:
    drawer = _known("drawer", choices.drawer, DRAWERS)
    return {
        "objects": (_source(task, choices, _UPRIGHT),),
        "drawer": drawer,
        "instruction": f"open {drawer} drawer",
        "second_instruction": f"place {object_words(choices.model)} into {drawer} drawer",
    }


def _known(what: str, value: str, there: Iterable[str]) -> str:
    if value not in there:
        raise LayoutError(f"{what}={value!r}: expected one of {', '.join(there)}")
    return value


def _draw_put_on(task: SimplerTask, seed: int) -> Choices:
    episode = int(_stream(seed).randint(num_arrangements(task)))
    return Choices(seed=seed, **stand(put_on_station(task)), overlay=task.overlays[0], episode_id=episode)


def _put_on(task: SimplerTask, choices: Choices) -> _FamilyFields:
    corners, turns = _put_on_choices(task.name)
    episode = _arrangement(task, choices)
    places, turn = corners[episode // len(turns)], turns[episode % len(turns)]
    objects = [
        Placed(model=model, role=role, position=_drop(task, *xy), quat=quat)
        for model, role, xy, quat in zip(task.models, ("source", "target"), places, (turn, _UPRIGHT), strict=True)
    ]
    if at_sink(task):
        objects.append(Placed(model=SINK, role="fixture", position=_SINK_POSITION, quat=_UPRIGHT))
    return {"objects": tuple(objects), "instruction": task.instruction, "episode_id": episode}


_XY = tuple[float, float]


def _put_on_choices(name: str) -> tuple[list[tuple[_XY, _XY]], list[Quat]]:
    """Where source and target may lie, and how the source may be turned; the target never is."""
    if name == "widowx_put_eggplant_in_basket":
        grid = itertools.product(np.linspace(-0.01, 0.01, 2), np.linspace(-0.015, 0.015, 4))
        places = [((float(x) - 0.105, float(y) + 0.206), (-0.125, 0.025)) for x, y in grid]
        return places, [yaw_quat(0.0), yaw_quat(math.pi / 4), yaw_quat(-math.pi / 4)]
    if name == "widowx_stack_cube":
        return _corner_pairs(0.05) + _corner_pairs(0.1), [_UPRIGHT]
    second = yaw_quat(math.pi / 2) if name == "widowx_spoon_on_towel" else yaw_quat(-math.pi / 2)
    first = _UPRIGHT if name == "widowx_spoon_on_towel" else yaw_quat(math.pi)
    return _corner_pairs(0.075), [first, second]


def _corner_pairs(half: float) -> list[tuple[_XY, _XY]]:
    """Ordered pairs of the corners of a square around (-0.16, 0), metres."""
    corners = [(-0.16 + half * x, half * y) for x, y in itertools.product((-1, 1), repeat=2)]
    return list(itertools.permutations(corners, 2))


# ---------------------------------------------------------------------------------------------------------------------
# Draws.


def _stream(seed: int) -> np.random.RandomState:
    return np.random.RandomState(seed)


def _choice(models: Sequence[str], rng: np.random.RandomState) -> str:
    """Upstream's ``random_choice``: a single candidate costs no draw."""
    return models[0] if len(models) == 1 else models[rng.randint(len(models))]


def _drop(task: SimplerTask, x: float, y: float) -> Vector:
    return float(x), float(y), task.stage.table_height + DROP_HEIGHT
