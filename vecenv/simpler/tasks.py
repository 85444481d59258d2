"""SIMPLER's 25 tasks as data: robot, scene, objects to choose from, camera, light, budget and success thresholds.

In: a suite (``simpler/bridge``, ``simpler/google_robot``) and a task's name or index. Out: a ``SimplerTask``. Names,
order and values are upstream's under ``prepackaged_config=True``, its visual-matching evaluation (SimplerEnv commit
4ab7178, ManiSkill2_real2sim commit ef7a4d4). Which object stands where in an episode is in ``layouts.py``; sizes and
densities of objects come from JSON files of the asset tree (``read_models``). Nothing here needs SAPIEN or assets.
"""

from __future__ import annotations

import difflib
import functools
import json
import operator
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any, SupportsIndex

import numpy as np

from vecenv.errors import InvalidFile, NotFound
from vecenv.simpler.control.robots import GOOGLE_ROBOT, WIDOWX, Robot

BRIDGE, GOOGLE = "simpler/bridge", "simpler/google_robot"
SUITES: tuple[str, ...] = (BRIDGE, GOOGLE)
NUM_EPISODES = 50
"""Episodes of every task."""
FIRST_SEED = 2022
"""Episode e has seed ``FIRST_SEED + e``."""
DATA = PurePosixPath("data")
"""Folder of objects, stages and pictures in the asset tree."""

DRAWERS = ("top", "middle", "bottom")
ORIENTATIONS = ("upright", "laid_vertically", "lr_switch")


class UnknownSuite(NotFound, KeyError):
    """No SIMPLER suite has this name; the message lists those that exist."""

    def __str__(self) -> str:
        return str(self.args[0])


class UnknownTask(NotFound):
    """A suite has no task of this name or index; the message gives the nearest or the valid range."""


class ModelDataError(InvalidFile):
    """A file with sizes and densities is missing or not what it should be; the message names it."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """The third-person camera, fixed to a link of the robot.

    Attributes:
        name: upstream's name.
        link: link it is fixed to.
        position: in the link's frame, metres.
        quat: wxyz, in the link's frame; x looks forward and z up, as in SAPIEN.
        width, height: pixels.
        focal: focal length, pixels, horizontally and vertically.
        centre: principal point, pixels.
        near, far: metres.
    """

    name: str
    link: str
    position: tuple[float, float, float]
    quat: tuple[float, float, float, float]
    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    near: float = 0.1
    far: float = 10.0

    @property
    def intrinsics(self) -> np.ndarray:
        """Camera matrix, [3, 3]."""
        return np.array([[self.focal[0], 0, self.centre[0]], [0, self.focal[1], self.centre[1]], [0, 0, 1]])


@dataclass(frozen=True, kw_only=True)
class DirectionalLight:
    """Parallel light: ``direction`` it travels in, world frame, and its ``colour``; ``shadow``: it casts shadows."""

    direction: tuple[float, float, float]
    colour: tuple[float, float, float]
    shadow: bool = False


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """Light of a scene: ``ambient`` colour and the directional lights; ``casts``: they cast shadows upstream."""

    ambient: tuple[float, float, float]
    directional: tuple[DirectionalLight, ...] = ()
    casts: bool = False


@dataclass(frozen=True, kw_only=True)
class Stage:
    """What stands around the workspace.

    Attributes:
        name: stem of its mesh among the stages, or None for a bare floor that is only drawn.
        offset: its origin is put at minus this, metres.
        table_height: objects are dropped from half a metre above, metres, world frame.
        turn: pose of the mesh in the stage's frame, xyz and wxyz, not normalised (as upstream has it).
        solid: whether it has collision shapes; the rooms around cabinets are only drawn.
    """

    name: str | None
    offset: tuple[float, float, float]
    table_height: float = 0.87
    turn: tuple[float, ...] = (0.0, 0.0, 0.0, 0.707, 0.707, 0.0, 0.0)
    solid: bool = True

    @property
    def mesh(self) -> PurePosixPath | None:
        """Path of its mesh in the asset tree; y is up in the file."""
        return DATA / "hab2_bench_assets/stages" / f"{self.name}.glb" if self.name else None


@dataclass(frozen=True, kw_only=True)
class PickSuccess:
    """The object was lifted: no contact with anything but the robot while higher than ``lift``, since the last grasp;
    or it was ``significant_lift`` high in so many steps altogether. Heights are since it settled, metres; impulses in
    N·s; the angle, degrees, takes the place of the robot's own.
    """

    impulse: float = 1e-6
    lift: float = 0.01
    significant_lift: float = 0.02
    significant_steps: int = 5
    grasp_angle: float = 80.0


@dataclass(frozen=True, kw_only=True)
class MoveNearSuccess:
    """The source object ends near the target. Metres, since the objects settled.

    Attributes:
        other_drop: how far the other objects may sink.
        drop: how far source and target may sink.
        moved: least distance that the source moves in xy, more than any other object does.
        gap: centres of mass may be this far apart in xy, beyond half of both bounding boxes' diagonals.
        closest: no other object may be nearer to the source by more than this.
    """

    other_drop: float = 0.02
    drop: float = 0.15
    moved: float = 0.03
    gap: float = 0.10
    closest: float = 0.01


@dataclass(frozen=True, kw_only=True)
class DrawerSuccess:
    """The drawer's joint is at least, or at most, ``threshold`` metres open; it starts at ``start``."""

    threshold: float
    opens: bool
    start: float = 0.0

    def reached(self, qpos: Any) -> np.ndarray:
        """Verdicts for joint positions of any shape, metres."""
        return np.asarray(qpos) >= self.threshold if self.opens else np.asarray(qpos) <= self.threshold


@dataclass(frozen=True, kw_only=True)
class PlaceSuccess:
    """The object touched the drawer's floor in some step, and the drawer is open, in the second half of the episode.

    Attributes:
        open: least joint position of the drawer, metres.
        impulse: least impulse of a contact, N·s.
        floor_shape: which collision shape of the drawer is its floor.
        second_half: control steps after which the second instruction holds whatever the policy does.
        start: the drawer's joint at the beginning, metres.
    """

    open: float = 0.05
    impulse: float = 1e-6
    floor_shape: int = 2
    second_half: int = 100
    start: float = 0.0


@dataclass(frozen=True, kw_only=True)
class PutOnSuccess:
    """The source object's centre of mass is above the target's, within its bounding box.

    Attributes:
        xy_slack: metres beyond half of the target box's xy diagonal.
        z_slack: metres between the boxes.
        clear: nothing but target and robot may touch the source.
        impulse: what counts as a touch, N·s.
    """

    xy_slack: float = 0.003
    z_slack: float = 0.02
    clear: bool = False
    impulse: float = 1e-6


Success = PickSuccess | MoveNearSuccess | DrawerSuccess | PlaceSuccess | PutOnSuccess


@dataclass(frozen=True, kw_only=True)
class SimplerTask:
    """One task.

    Attributes:
        suite: ``simpler/bridge`` or ``simpler/google_robot``.
        index: place in the suite, from 0, in upstream's order.
        name: upstream's name.
        family: ``pick``, ``move_near``, ``open``, ``close``, ``place`` or ``put_on``.
        instruction: what a policy is told; words in capitals depend on the episode (see ``Layout.instruction``).
        robot: the robot.
        max_steps: step budget, control steps.
        models: objects an episode chooses from; of ``put_on``, source and target.
        triplets: of ``move_near``, the groups of objects.
        drawers: drawers an episode chooses from.
        orientation: how the can stands; None when an episode chooses.
        models_file: JSON file with sizes and densities, in the asset tree; "" where there are no objects.
        stage: surroundings.
        station: the cabinet's URDF file in the asset tree, or None.
        contact_offset: PhysX's, metres.
        overlays: real pictures that replace the background, in the asset tree; an episode chooses one.
        always_overlaid: objects that the picture replaces too.
        camera: the third-person camera.
        lighting: light.
        ray_traced: upstream draws it with its ray tracer.
        shiny: upstream gives the robot's links specular 0.9 and roughness 0.3.
        matte: upstream draws the objects with roughness 1, metallic 0 and specular 0.
        success: when the task is solved.
    """

    suite: str
    index: int
    name: str
    family: str
    instruction: str
    robot: Robot
    max_steps: int
    models: tuple[str, ...] = ()
    triplets: tuple[tuple[str, str, str], ...] = ()
    drawers: tuple[str, ...] = ()
    orientation: str | None = None
    models_file: str = ""
    stage: Stage
    station: PurePosixPath | None = None
    contact_offset: float = 0.02
    overlays: tuple[PurePosixPath, ...]
    always_overlaid: tuple[str, ...] = ()
    camera: Camera
    lighting: Lighting
    ray_traced: bool = False
    shiny: bool = True
    matte: bool = False
    success: Success

    @property
    def control_hz(self) -> int:
        """Control steps a second."""
        return self.robot.control_hz

    @property
    def sim_hz(self) -> int:
        """Physics substeps a second."""
        return self.robot.sim_hz

    @property
    def models_path(self) -> PurePosixPath | None:
        """Path of ``models_file`` in the asset tree."""
        return DATA / "custom" / self.models_file if self.models_file else None


# ---------------------------------------------------------------------------------------------------------------------
# Objects: sizes and densities.


@dataclass(frozen=True, kw_only=True)
class ModelInfo:
    """An object's size and weight.

    Attributes:
        name: its name, also of its folder.
        bbox_min, bbox_max: corners of its bounding box, metres, in its own frame, [3].
        density: kg/m³.
    """

    name: str
    bbox_min: np.ndarray
    bbox_max: np.ndarray
    density: float

    @property
    def size(self) -> np.ndarray:
        """Extents of the bounding box, metres, [3]."""
        return self.bbox_max - self.bbox_min


def model_folder(name: str) -> PurePosixPath:
    """Folder of an object's meshes in the asset tree."""
    return DATA / "custom/models" / name


def read_models(path: Path) -> dict[str, ModelInfo]:
    """Sizes and densities of the objects in one of SIMPLER's JSON files.

    Raises:
        ModelDataError: the file is missing, damaged, or lists an object in another size than its own (SIMPLER has none,
            and layouts rely on it).
    """
    try:
        entries = json.loads(path.read_bytes())
        return {name: _model(name, entry) for name, entry in entries.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ModelDataError(f"{path}: no sizes and densities of objects: {type(error).__name__}: {error}") from error


def _model(name: str, entry: Mapping[str, Any]) -> ModelInfo:
    low, high = (np.array(entry["bbox"][key], np.float64) for key in ("min", "max"))
    if low.shape != (3,) or high.shape != (3,):
        raise ValueError(f"the bounding box of {name!r} is not two points")
    if list(entry.get("scales", [1.0])) != [1.0]:
        raise ValueError(f"{name!r} has scales {entry['scales']}; only 1.0 is supported")
    return ModelInfo(name=name, bbox_min=low, bbox_max=high, density=float(entry.get("density", 1000)))


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
BRIDGE_TABLE = Stage(name="bridge_table_1_v1", offset=_BRIDGE_OFFSET)
SINK_TABLE = Stage(name="bridge_table_1_v2", offset=_BRIDGE_OFFSET)
COKE_TABLE = Stage(name="google_pick_coke_can_1_v4", offset=_GOOGLE_OFFSET)
BARE_FLOOR = Stage(name=None, offset=_GOOGLE_OFFSET)


def _picture(name: str) -> PurePosixPath:
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


def _google(name: str, family: str, instruction: str, success: Success, **fields: Any) -> dict[str, Any]:
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
        overlays=(_picture("google_coke_can_real_eval_1"),),
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
        overlays=(_picture("google_move_near_real_eval_1"),),
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
        overlays=tuple(_picture(f"open_drawer_{row}{column}") for row in "abc" for column in "012"),
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
        overlays=tuple(_picture(f"open_drawer_{row}0") for row in "abc"),
        **_STATION,
    )


def _put_on(name: str, instruction: str, source: str, target: str, success: Success, **fields: Any) -> dict[str, Any]:
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
        "overlays": (_picture("bridge_real_eval_1"),),
        "camera": BRIDGE_CAMERA,
        "lighting": TABLE_LIGHT,
        "success": success,
        **fields,
    }


_COKE, _PICK_COKE = ("opened_coke_can",), "pick coke can"
_TABLE: tuple[dict[str, Any], ...] = (
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
        overlays=(_picture("bridge_sink"),),
        always_overlaid=("sink", "dummy_sink_target_plane"),
        camera=SINK_CAMERA,
        lighting=SINK_LIGHT,
    ),
)


def _suite_tasks(suite: str) -> tuple[SimplerTask, ...]:
    rows = [row for row in _TABLE if row["suite"] == suite]
    return tuple(SimplerTask(index=index, **row) for index, row in enumerate(rows))


TASKS: Mapping[str, SimplerTask] = MappingProxyType(
    {task.name: task for suite in SUITES for task in _suite_tasks(suite)}
)
"""All 25 tasks by name, suite by suite."""


@functools.cache
def list_tasks(suite: str) -> tuple[SimplerTask, ...]:
    """Tasks of a suite in upstream's order.

    Raises:
        UnknownSuite: no such suite.
    """
    if suite not in SUITES:
        raise UnknownSuite(f"no suite {suite!r}; SIMPLER's suites: {', '.join(SUITES)}")
    return tuple(task for task in TASKS.values() if task.suite == suite)


def find_task(suite: str, which: str | SupportsIndex) -> SimplerTask:
    """One task of a suite, by upstream's name or by index.

    Raises:
        UnknownSuite: no such suite.
        UnknownTask: no such task; negative indices are not counted from the end.
    """
    tasks = list_tasks(suite)
    if isinstance(which, str):
        return _by_name(suite, which, tasks)
    place = operator.index(which)
    if not 0 <= place < len(tasks):
        raise UnknownTask(f"{suite} has tasks 0 to {len(tasks) - 1}, not {place}")
    return tasks[place]


def _by_name(suite: str, name: str, tasks: Iterable[SimplerTask]) -> SimplerTask:
    names = {task.name: task for task in tasks}
    if name not in names:
        near = difflib.get_close_matches(name, names, n=3) or names
        raise UnknownTask(f"{suite} has no task {name!r}: did you mean {', '.join(near)}?")
    return names[name]


def eval_metadata(suite: str, protocol: str = "seed") -> dict[str, Any]:
    """What an evaluation of a suite consists of, with the keys of ``vecenv.eval_metadata``; budgets are a task's own.

    Args:
        suite: the suite.
        protocol: one of ``published.PROTOCOLS``. Under upstream's lists ``episodes_per_task`` is a tuple, one number a
            task, 0 where upstream has none.

    Raises:
        UnknownSuite: no such suite.
        PublishedError: no such protocol, or it has no episodes of this suite.
    """
    from vecenv.simpler.published import lists as published  # it builds on this module

    tasks, there = list_tasks(suite), published.counts(protocol, suite)
    counts = tuple(there.get(task.index, 0) for task in tasks)
    return {
        "suite": suite,
        "protocol": protocol,
        "num_tasks": len(tasks),
        "episodes_per_task": NUM_EPISODES if protocol == published.SEED else counts,
        "num_episodes": sum(counts),
        "max_steps": tuple(task.max_steps for task in tasks),
        "metrics": ("success", "num_steps", "cumulative_reward"),
        "action_space": ("step_continuous", "step_ee_pose"),
        "control_hz": tasks[0].control_hz,
        "instructions": tuple(task.instruction for task in tasks),
    }
