"""What an episode of SIMPLER consists of: which objects, where they are dropped, where the robot stands, what is said.

In: a task and a seed. Out: a ``Layout``, decided by NumPy's ``RandomState`` alone, draw for draw as upstream does it
(ManiSkill2_real2sim commit ef7a4d4, ``envs/custom_scenes``). Each class of upstream's hierarchy starts the episode's
stream anew, so draws of different layers are made from equal streams: that is why several functions begin with a fresh
``RandomState(seed)``. Objects are given where they are dropped, half a metre above the table; where they end is the
simulator's business.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import TypedDict

import numpy as np

from vecenv.simpler.tasks import FIRST_SEED, NUM_EPISODES, ORIENTATIONS, SimplerTask

Vector = tuple[float, float, float]
Quat = tuple[float, float, float, float]
_UPRIGHT: Quat = (1.0, 0.0, 0.0, 0.0)
DROP_HEIGHT = 0.5
"""Metres above the table from which objects are dropped."""

SINK = "sink"
_SINK_POSITION: Vector = (-0.16, 0.13, 0.88)
# Toy fruit weighs less than the models' files say; upstream overrides them in move_near only.
_LIGHT_FRUIT = ("baked_apple", "baked_apple_v2", "orange")
_LIGHT_DENSITY = 200.0


class LayoutError(ValueError):
    """A seed or episode that does not exist; the message says which do."""


@dataclass(frozen=True, kw_only=True)
class Placed:
    """An object at the beginning of an episode.

    Attributes:
        model: its name, also of its folder in the asset tree.
        role: ``source`` (what is to be moved), ``target``, ``other``, ``distractor`` (likewise, but dropped when the
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
        seed: what it was drawn from.
        objects: in upstream's order.
        base_position: of the robot's root link, metres, world frame.
        base_quat: wxyz.
        qpos: the robot's joints, radians and metres, in the order of ``Robot.joints``.
        urdf_version: which of the robot's versions.
        overlay: picture that replaces the background, in the asset tree.
        drawer: which drawer the task is about, "" when none.
        drawer_qpos: how far it is open at first, metres.
        instruction: what a policy is told at first.
        second_instruction: what it is told in the second half of a ``place`` episode, else "".
        orientation: of ``pick``, how the object lies.
        episode_id: upstream's number of the arrangement, None where it has none.
    """

    task: str
    seed: int
    objects: tuple[Placed, ...]
    base_position: Vector
    base_quat: Quat
    qpos: tuple[float, ...]
    urdf_version: str = ""
    overlay: PurePosixPath
    drawer: str = ""
    drawer_qpos: float = 0.0
    instruction: str
    second_instruction: str = ""
    orientation: str = ""
    episode_id: int | None = None

    def with_role(self, role: str) -> tuple[Placed, ...]:
        """The objects of a role."""
        return tuple(placed for placed in self.objects if placed.role == role)


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
    if not 0 <= seed < 2**32:
        raise LayoutError(f"seed {seed} is not between 0 and 2**32 - 1")
    makers = {
        "pick": _pick,
        "move_near": _move_near,
        "open": _drawer,
        "close": _drawer,
        "place": _place,
        "put_on": _put_on,
    }
    return makers[task.family](task, seed)


def object_words(model: str) -> str:
    """An object's name as instructions say it: upstream's ``_get_instruction_obj_name``."""
    silent = {"opened", "light", "generated", "modified", "objaverse", "bridge", "baked", "v2"}
    return " ".join(word for word in model.split("_") if word not in silent and not word.endswith("cm"))


# ---------------------------------------------------------------------------------------------------------------------
# The robots' first postures.

_GOOGLE_QPOS = (
    -0.2639457174606611,
    0.0831913360274175,
    0.5017611504652179,
    1.156859026208673,
    0.028583671314766423,
    1.592598203487462,
    -1.080652960128774,
    0.0,
    0.0,
    -0.00285961,
    0.7851361,
)
_WIDOWX_QPOS = (-0.01840777, 0.0398835, 0.22242722, -0.00460194, 1.36524296, 0.00153398, 0.037, 0.037)
_SINK_QPOS = (-0.2600599, -0.12875618, 0.04461369, -0.00652761, 1.7033415, -0.26983038, 0.037, 0.037)
_WIDOWX_BASE: Vector = (0.147, 0.028, 0.87)
_SINK_BASE: Vector = (0.127, 0.06, 0.85)
# The base's own height and the floor's.
_GOOGLE_HEIGHT = 0.06205 + 0.017
_TURNED: Quat = (0.0, 0.0, 0.0, 1.0)

# Where the real robot stood when the pictures of the drawers were taken: x, y (metres) and yaw (radians).
_STATIONS = {
    "a0": (0.644, -0.179, -0.03),
    "a1": (0.765, -0.182, -0.02),
    "a2": (0.889, -0.203, -0.06),
    "b0": (0.652, 0.009, 0.0),
    "b1": (0.752, 0.009, 0.0),
    "b2": (0.851, 0.035, 0.0),
    "c0": (0.665, 0.224, 0.0),
    "c1": (0.765, 0.222, -0.025),
    "c2": (0.865, 0.222, -0.025),
}


class _Base(TypedDict):
    base_position: Vector
    base_quat: Quat


def _google_base(x: float, y: float, yaw: float = 0.0) -> _Base:
    return {"base_position": (x, y, _GOOGLE_HEIGHT), "base_quat": _multiply(_yaw(yaw), _TURNED)}


# ---------------------------------------------------------------------------------------------------------------------
# Families.


def _pick(task: SimplerTask, seed: int) -> Layout:
    orientation = task.orientation or str(_stream(seed).choice(list(ORIENTATIONS)))
    rng = _stream(seed)
    model = _choice(task.models, rng)
    version = str(rng.choice(list(task.robot.versions)))
    x, y = _stream(seed).uniform([-0.35, -0.02], [-0.12, 0.42], [2])
    turns = {"upright": _roll(math.pi / 2), "laid_vertically": _yaw(math.pi / 2), "lr_switch": _yaw(math.pi)}
    return Layout(
        task=task.name,
        seed=seed,
        objects=(Placed(model=model, role="source", position=_drop(task, x, y), quat=turns[orientation]),),
        **_google_base(0.35, 0.20),
        qpos=_GOOGLE_QPOS,
        urdf_version=version,
        overlay=task.overlays[0],
        instruction=f"pick {object_words(model)}",
        orientation=orientation,
    )


_PAIRS = tuple(itertools.permutations(range(3), 2))
_TRIANGLES = (((-0.33, 0.04), (-0.33, 0.34), (-0.13, 0.19)), ((-0.13, 0.04), (-0.33, 0.19), (-0.13, 0.34)))


def _move_near(task: SimplerTask, seed: int) -> Layout:
    per_triplet = len(_PAIRS) * len(_TRIANGLES)
    episode = int(_stream(seed).randint(len(task.triplets) * per_triplet))
    version = str(_stream(seed).choice(list(task.robot.versions)))
    triplet, corners = task.triplets[episode // per_triplet], _TRIANGLES[episode % per_triplet // len(_PAIRS)]
    source, target = _PAIRS[episode % len(_PAIRS)]
    roles = {source: "source", target: "target"}
    return Layout(
        task=task.name,
        seed=seed,
        objects=tuple(
            Placed(
                model=model,
                role=roles.get(i, "other"),
                position=_drop(task, *corners[i]),
                quat=_standing(model),
                density=_LIGHT_DENSITY if model in _LIGHT_FRUIT else None,
            )
            for i, model in enumerate(triplet)
        ),
        **_google_base(0.35, 0.21, -0.09),
        qpos=_GOOGLE_QPOS,
        urdf_version=version,
        overlay=task.overlays[0],
        instruction=f"move {object_words(triplet[source])} near {object_words(triplet[target])}",
        episode_id=episode,
    )


def _standing(model: str) -> Quat:
    """How an object of ``move_near`` is put down: cans and bottles have their axis along y."""
    if "apple" in model:
        return _UPRIGHT
    if "can" in model.split("_"):
        return _roll(math.pi / 2)
    return _multiply(_yaw(math.pi / 2), _roll(math.pi / 2)) if "bottle" in model else _yaw(math.pi / 2)


def _drawer(task: SimplerTask, seed: int) -> Layout:
    drawer, overlay, version = _draw_station(task, seed)
    return Layout(
        task=task.name,
        seed=seed,
        objects=(),
        **_google_base(*_STATIONS[_station_name(overlay)]),
        qpos=_GOOGLE_QPOS,
        urdf_version=version,
        overlay=overlay,
        drawer=drawer,
        drawer_qpos=getattr(task.success, "start", 0.0),
        instruction=f"{task.family} {drawer} drawer",
    )


def _place(task: SimplerTask, seed: int) -> Layout:
    model = _choice(task.models, _stream(seed))
    drawer, overlay, version = _draw_station(task, seed)
    x, y = _stream(seed).uniform([-0.10, -0.00], [-0.05, 0.1], [2])
    return Layout(
        task=task.name,
        seed=seed,
        objects=(Placed(model=model, role="source", position=_drop(task, x, y), quat=_UPRIGHT),),
        **_google_base(*_STATIONS[_station_name(overlay)]),
        qpos=_GOOGLE_QPOS,
        urdf_version=version,
        overlay=overlay,
        drawer=drawer,
        instruction=f"open {drawer} drawer",
        second_instruction=f"place {object_words(model)} into {drawer} drawer",
    )


def _draw_station(task: SimplerTask, seed: int) -> tuple[str, PurePosixPath, str]:
    """Drawer, picture and URDF version, drawn from one stream."""
    rng = _stream(seed)
    drawer = str(rng.choice(list(task.drawers)))
    overlay = task.overlays[int(rng.choice(len(task.overlays)))]
    return drawer, overlay, str(rng.choice(list(task.robot.versions)))


def _station_name(overlay: PurePosixPath) -> str:
    return overlay.stem.rsplit("_", 1)[-1]


def _put_on(task: SimplerTask, seed: int) -> Layout:
    sink = task.name == "widowx_put_eggplant_in_basket"
    corners, turns = _put_on_choices(task.name)
    episode = int(_stream(seed).randint(len(corners) * len(turns)))
    places, turn = corners[episode // len(turns)], turns[episode % len(turns)]
    objects = [
        Placed(model=model, role=role, position=_drop(task, *xy), quat=quat)
        for model, role, xy, quat in zip(task.models, ("source", "target"), places, (turn, _UPRIGHT), strict=True)
    ]
    if sink:
        objects.append(Placed(model=SINK, role="fixture", position=_SINK_POSITION, quat=_UPRIGHT))
    return Layout(
        task=task.name,
        seed=seed,
        objects=tuple(objects),
        base_position=_SINK_BASE if sink else _WIDOWX_BASE,
        base_quat=_TURNED,
        qpos=_SINK_QPOS if sink else _WIDOWX_QPOS,
        overlay=task.overlays[0],
        instruction=task.instruction,
        episode_id=episode,
    )


_XY = tuple[float, float]


def _put_on_choices(name: str) -> tuple[list[tuple[_XY, _XY]], list[Quat]]:
    """Where source and target may lie, and how the source may be turned; the target never is."""
    if name == "widowx_put_eggplant_in_basket":
        grid = itertools.product(np.linspace(-0.01, 0.01, 2), np.linspace(-0.015, 0.015, 4))
        places = [((float(x) - 0.105, float(y) + 0.206), (-0.125, 0.025)) for x, y in grid]
        return places, [_yaw(0.0), _yaw(math.pi / 4), _yaw(-math.pi / 4)]
    if name == "widowx_stack_cube":
        return _corner_pairs(0.05) + _corner_pairs(0.1), [_UPRIGHT]
    second = _yaw(math.pi / 2) if name == "widowx_spoon_on_towel" else _yaw(-math.pi / 2)
    first = _UPRIGHT if name == "widowx_spoon_on_towel" else _yaw(math.pi)
    return _corner_pairs(0.075), [first, second]


def _corner_pairs(half: float) -> list[tuple[_XY, _XY]]:
    """Ordered pairs of the corners of a square around (-0.16, 0), metres."""
    corners = [(-0.16 + half * x, half * y) for x, y in itertools.product((-1, 1), repeat=2)]
    return list(itertools.permutations(corners, 2))


# ---------------------------------------------------------------------------------------------------------------------
# Draws and rotations.


def _stream(seed: int) -> np.random.RandomState:
    return np.random.RandomState(seed)


def _choice(models: Sequence[str], rng: np.random.RandomState) -> str:
    """Upstream's ``random_choice``: a single candidate costs no draw."""
    return models[0] if len(models) == 1 else models[rng.randint(len(models))]


def _drop(task: SimplerTask, x: float, y: float) -> Vector:
    return float(x), float(y), task.stage.table_height + DROP_HEIGHT


def _yaw(angle: float) -> Quat:
    return math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)


def _roll(angle: float) -> Quat:
    return math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0


def _multiply(a: Quat, b: Quat) -> Quat:
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
