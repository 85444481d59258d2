"""One episode of SIMPLER's evaluation lists as data, and what a task's episodes have in common.

``EpisodeSpec`` says everything that upstream's evaluation loop (SimplerEnv commit 4ab7178,
``simpler_env/evaluation/maniskill2_evaluator.py``) fixes of an episode. ``lists.py`` has the lists.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from vecenv.simpler.control.robots import GOOGLE_ROBOT
from vecenv.simpler.layouts import Choices
from vecenv.simpler.task_spec import SimplerTask
from vecenv.simpler.task_table import COKE_TABLE
from vecenv.simpler.tasks import TASKS
from vecenv.simpler.variants import Variant

VISUAL_MATCHING, VARIANT_AGGREGATION, SEED = "visual-matching", "variant-aggregation", "seed"
PROTOCOLS = (VISUAL_MATCHING, VARIANT_AGGREGATION, SEED)
"""``seed`` is not upstream's: seeds 2022 to 2071 of every task in the setup of visual matching."""
BuildKwargs = tuple[tuple[str, str | bool], ...]


@dataclass(frozen=True, kw_only=True)
class EpisodeSpec(Choices):
    """One episode: everything that upstream's evaluation loop fixes, beside what ``Choices`` has.

    Attributes:
        protocol: one of ``PROTOCOLS``.
        task: the task's name.
        index: its number in the task's list, from 0.
        source: upstream's script, a path in SimplerEnv.
        setting: what the script varies here: ``base`` (nothing), ``background``, ``lighting``, ``table``,
            ``distractors``, ``camera`` or ``cabinet``.
        averaged: whether upstream's average (``tools/calc_metrics_evaluation_videos.py``) counts it; it leaves out
            turned cameras.
        environment: ManiSkill2_real2sim's name of the environment.
        robot: upstream's name of the robot and its camera.
        scene: upstream's name of the surroundings; ``dummy_drawer`` is a bare floor that is only drawn.
        station: name of the cabinet's file, "" without a cabinet.
        lighting: a name of ``variants.TABLE_LIGHTS`` or ``CABINET_LIGHTS``; "" for visual matching's.
        camera: a name of ``variants.CAMERAS``, "" for the usual tilt of the head.
        distractors: a name of ``variants.DISTRACTORS``, ``none`` for a ``move_near`` without its third object, or "".
        max_steps: step budget, control ticks.
        control_hz, sim_hz: control ticks and physics steps a second.
        control_mode: upstream's name of the controller.
        build_kwargs: upstream's ``additional_env_build_kwargs``, name and value, as the script has them.
    """

    protocol: str
    task: str
    index: int = 0
    source: str
    setting: str = "base"
    averaged: bool = True
    environment: str
    robot: str
    scene: str
    station: str = ""
    lighting: str = ""
    camera: str = ""
    distractors: str = ""
    max_steps: int
    control_hz: int
    sim_hz: int
    control_mode: str
    build_kwargs: BuildKwargs = ()

    @property
    def variant(self) -> Variant:
        """What differs from visual matching's scene, apart from the room around a cabinet."""
        on_table = not self.station and self.scene != COKE_TABLE.name and TASKS[self.task].robot is GOOGLE_ROBOT
        station = TASKS[self.task].station
        return Variant(
            lighting=self.lighting or None,
            camera=self.camera or None,
            station=self.station if station is not None and self.station != station.stem else None,
            stage=self.scene if on_table else None,
            distractors=self.distractors or None,
        )


# ---------------------------------------------------------------------------------------------------------------------
# What all rows of a task share.

COKE_ENVIRONMENT, MOVE_NEAR_ENVIRONMENT = "GraspSingleOpenedCokeCan{}InScene-v0", "MoveNear{}InScene-v0"
"""Names with a gap for what a script varies by the environment."""
_DRAWER = "{}{}DrawerCustomInScene-v0"
_ENVIRONMENTS: Mapping[str, str] = MappingProxyType(
    {
        "widowx_spoon_on_towel": "PutSpoonOnTableClothInScene-v0",
        "widowx_carrot_on_plate": "PutCarrotOnPlateInScene-v0",
        "widowx_stack_cube": "StackGreenCubeOnYellowCubeBakedTexInScene-v0",
        "widowx_put_eggplant_in_basket": "PutEggplantInBasketScene-v0",
        "google_robot_pick_object": "GraspSingleRandomObjectInScene-v0",
        "google_robot_move_near_v0": MOVE_NEAR_ENVIRONMENT.format("GoogleBakedTex"),
        "google_robot_move_near_v1": "MoveNearGoogleBakedTexInScene-v1",
        "google_robot_move_near": "MoveNearGoogleBakedTexInScene-v1",
    }
)
_VERBS: Mapping[str, str] = MappingProxyType({"open": "Open", "close": "Close", "place": "PlaceIntoClosed"})
_ARM = "arm_pd_ee_{}_gripper_pd_joint_{}"
_CONTROL_MODES: Mapping[str, str] = MappingProxyType(
    {
        "google_robot": _ARM.format(
            "delta_pose_align_interpolate_by_planner", "target_delta_pos_interpolate_by_planner"
        ),
        "widowx": _ARM.format("target_delta_pose_align2", "pos"),
    }
)


def common_fields(task: SimplerTask, protocol: str, source: str, drawer: str = "") -> dict[str, Any]:
    """Fields of an ``EpisodeSpec`` that a task decides; ``drawer`` where its environments have one each."""
    sink = task.name == "widowx_put_eggplant_in_basket"
    return {
        "protocol": protocol,
        "task": task.name,
        "source": source,
        "environment": _environment(task, drawer),
        "robot": "google_robot_static" if task.robot is GOOGLE_ROBOT else f"widowx{'_sink_camera_setup' * sink}",
        "scene": task.stage.name or "dummy_drawer",
        "station": task.station.stem if task.station else "",
        "max_steps": task.max_steps,
        "control_hz": task.control_hz,
        "sim_hz": task.sim_hz,
        "control_mode": _CONTROL_MODES[task.robot.name],
    }


def _environment(task: SimplerTask, drawer: str) -> str:
    if task.name in _ENVIRONMENTS:
        return _ENVIRONMENTS[task.name]
    if task.family == "pick":
        return COKE_ENVIRONMENT.format("")
    which = drawer or (task.drawers[0] if len(task.drawers) == 1 else "")
    return _DRAWER.format(_VERBS[task.family], which.capitalize())
