"""SIMPLER's WidowX scenes for VoxPoser: conversions of the hand's frame, of names and of the gripper's sign.

A batch of ``simpler/bridge`` comes in; :func:`hands` wraps it in a batch whose poses are those of VoxPoser's hand
(third column out of the palm, second the closing direction, grip site between the pads) and gives the agent's options
for that robot. Objects get the names that the instructions use. Nothing of the task is read beyond what
:mod:`voxposer.perception` reads.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from vecenv.actions import GRIPPER, ee_pose_fields
from vecenv.contract import BatchEnv, Control, EePoseControl, Metrics, PlanControl, ResetInfo, State, Timings, Watcher
from vecenv.errors import InvalidInput
from vecenv.manipulation.grasps import Gripper
from vecenv.manipulation.routes import RouteConfig
from vecenv.manipulation.world import Margins, matrix
from vecenv.observations import Egocentric, Objects, ObjectsSnapshot, PointCloud
from vecenv.placement import Placement
from vecenv.simpler.assets.files import simpler_root
from vecenv.simpler.control.chain import Chain
from vecenv.simpler.control.robots import WIDOWX
from vecenv.simpler.control.urdf import read_urdf
from voxposer.agent import AgentConfig
from voxposer.perception.config import PerceptionConfig
from voxposer.planning.plan import PlanConfig, SubtaskPlan
from voxposer.quaternions import quaternion

SUITE = "simpler/bridge"
FAMILY = "simpler/"
_NATIVE = "native"
# Columns: VoxPoser's hand in the frame of WidowX's tool, which points along its x and opens along its y.
HAND_IN_TOOL = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
# From a finger joint's position to the distance of its pad from the middle, metres (measured on the collision meshes).
PAD_OFFSET = 0.011
# WidowX's fingers and the bar behind them, measured on the collision meshes in the tool's frame, fingers open.
WIDOWX_GRIPPER = Gripper(
    half_opening=0.026,
    half_reach=0.042,
    finger_half_width=0.0145,
    tip=0.0156,
    pad=(-0.0120, 0.0160),
    palm=0.022,
    palm_half=(0.0523, 0.0360),
)
# Names of the models in the instructions.
NAMES: Mapping[str, str] = MappingProxyType(
    {
        "bridge_spoon_generated_modified": "spoon",
        "table_cloth_generated_shorter": "towel",
        "bridge_carrot_generated_modified": "carrot",
        "bridge_plate_objaverse_larger": "plate",
        "baked_green_cube_3cm": "green_block",
        "baked_yellow_cube_3cm": "yellow_block",
        "eggplant": "eggplant",
        "dummy_sink_target_plane": "yellow_basket",
        "sink": "sink",
    }
)
# Distance of the tool from the robot's base at the start of an episode; the robot faces -x. Metres.
_HOME_REACH = -0.28
# Corners of the workspace, relative to the robot's base horizontally and to the table vertically, metres.
_WORKSPACE = ((-0.585, -0.385, -0.07), (-0.035, 0.365, 0.43))
# Samples of a table that the snapshot has no points of: half a side and distance, metres.
_TABLE_HALF, _TABLE_STEP = 0.5, 0.1


class NoHandView(InvalidInput):
    """VoxPoser does not support this suite's robot; the message lists those it supports."""


def widowx_config(passes: int = 3, seeing: PerceptionConfig = PerceptionConfig()) -> AgentConfig:  # noqa: B008  (frozen)
    """The agent's options for WidowX at 5 ticks a second, whose episodes last 60 or 120 ticks.

    Args:
        passes: how often an instruction is planned.
        seeing: where observations come from; the rest of it is not used.
    """
    margins = Margins(
        gripper=WIDOWX_GRIPPER, above=0.05, corridor=0.06, narrow=0.02, easy_reach=0.40, least_room=0.002, retreat=0.06
    )
    # Empty, closed fingers stop 8 mm apart.
    # The basket in the sink is in the photograph behind the scene, so it has no mask; its name has a colour.
    camera = replace(seeing.camera, workspace=_WORKSPACE, colored=True)
    perception = PerceptionConfig(
        source=seeing.source,
        camera=camera,
        margins=margins,
        held_box=(0.018, 0.008, 0.020),
        closed_gap=0.0095,
        home_reach=_HOME_REACH,
    )
    # Waypoints are left within 1 cm and 0.1 rad, and a hand tilted so far loses a spoon: 3 more ticks at each stop.
    plan = PlanConfig(hold_ticks=3, settle=3, full_speed=0.03)
    # High above the table's far side the hand cannot point down: the wrist ends at 1.79 rad.
    route = RouteConfig(mode="raised", over=0.02, corridor=0.06, approach=0.03)
    return AgentConfig(perception=perception, route=route, plan=plan, passes=passes, idle_ticks=10)


def hands(env: BatchEnv, suite: str, config: AgentConfig) -> tuple[BatchEnv, AgentConfig]:
    """An environment and options for the agent: both as they are, or for ``simpler/bridge`` a :class:`HandView` of it.

    Raises:
        NoHandView: another robot of SIMPLER.
    """
    if not suite.startswith(FAMILY):
        return env, config
    if suite != SUITE:
        raise NoHandView(f"voxposer knows Panda's and WidowX's hands: {SUITE} of SIMPLER's suites, not {suite}")
    return HandView(env), widowx_config(config.passes, config.perception)


class HandView:
    """A batch of ``simpler/bridge`` with VoxPoser's hand and names; see ``vecenv.contract`` for the verbs.

    ``step_continuous`` takes LIBERO's gripper sign, +1 closes, as the agent gives it.

    Args:
        env: the batch.
    """

    def __init__(self, env: BatchEnv) -> None:
        self.env, self.suite, self.num_envs = env, env.suite, env.num_envs
        option = getattr(env.config, "gripper", _NATIVE)
        self._gripper = GRIPPER[SUITE if option == _NATIVE else option]

    @property
    def config(self) -> object:
        """The environment's options."""
        return self.env.config

    @property
    def control_hz(self) -> float:
        """Control ticks a second."""
        return self.env.control_hz

    @property
    def placement(self) -> Placement:
        """Task and episode of each slot."""
        return self.env.placement

    @property
    def done(self) -> np.ndarray:
        """Which slots have finished their episode, bool [B]."""
        return self.env.done

    @property
    def timings(self) -> Timings:
        """Seconds spent so far in physics and in rendering images."""
        return self.env.timings

    def instructions(self) -> tuple[str, ...]:
        """The present instruction of each slot."""
        return self.env.instructions()

    def reset(self) -> ResetInfo:
        """Make every slot live."""
        return self.env.reset()

    def set_episodes(
        self,
        *,
        tasks: object = None,
        episodes: object = None,
        slots: npt.ArrayLike | None = None,
    ) -> None:
        """Choose what each slot runs next, or some slots."""
        self.env.set_episodes(tasks=tasks, episodes=episodes, slots=slots)

    def evaluate(self) -> Metrics:
        """Verdicts."""
        return self.env.evaluate()

    def end_episodes(self, slots: npt.ArrayLike) -> None:
        """End the episodes of some slots."""
        self.env.end_episodes(slots)

    def state(self) -> State:
        """Physics state of every slot, a copy."""
        return self.env.state()

    def set_state(self, state: State) -> None:
        """Overwrite the physics state of every slot."""
        self.env.set_state(state)

    def watched(self, watcher: Watcher) -> AbstractContextManager[None]:
        """While inside, ``watcher`` is called before every tick of an episode."""
        return self.env.watched(watcher)

    def observe_egocentric(self, slots: npt.ArrayLike | None = None) -> Egocentric:
        """Cameras and joints, instances under the names that the instructions use; images of some slots only."""
        seen = self.env.observe_egocentric(slots)
        return replace(seen, instances=tuple(tuple(map(called, names)) for names in seen.instances))

    @functools.cached_property
    def _arm(self) -> Chain:
        """Kinematics of the tool."""
        root = simpler_root(getattr(self.env.config, "assets", None))
        return read_urdf(root / WIDOWX.urdf_path()).chain(WIDOWX.tool, WIDOWX.joints)

    def hand_state(self, seen: Egocentric) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the hands, xyz + wxyz, [B, 7], and distances of their pads from the middle, metres, [B, 2].

        They follow from the joint positions and the pose of the base in the proprioception.
        """
        state = np.asarray(seen.state, float)
        pos, rotation = self._arm.pose(state[:, : WIDOWX.dof])
        turn = np.array([matrix(quat) for quat in state[:, -4:]])
        tools = [
            np.append(base[:3] + about @ p, quaternion(about @ r))
            for base, about, p, r in zip(state[:, -7:], turn, pos, rotation, strict=True)
        ]
        return hand_poses(np.array(tools)), np.array([_pads(row) for row in state[:, list(WIDOWX.gripper)]])

    def close(self) -> None:
        """Release the simulator."""
        self.env.close()

    def step_continuous(self, actions: npt.ArrayLike) -> Control:
        """Advance; the gripper column is LIBERO's."""
        column = self._gripper
        converted = np.array(actions, float)
        converted[..., 6] = np.where(converted[..., 6] > 0, column.closed, column.open)
        return self.env.step_continuous(converted)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def step_ee_pose(
        self,
        poses: npt.ArrayLike | Mapping[str, object] | None,
        hold_steps: npt.ArrayLike = 0,
        *,
        carry: npt.ArrayLike = False,
        slots: npt.ArrayLike | None = None,
    ) -> EePoseControl:
        """Drive the hand to poses, [B, 8]; the final pose returned is the hand's."""
        given: dict[str, Any] = {"hold_steps": hold_steps, "carry": carry, "slots": slots, **ee_pose_fields(poses)}
        converted = np.array(() if given.get("pose") is None else given["pose"], float)
        if converted.size:
            converted[..., :7] = tool_poses(converted[..., :7])
        control = self.env.step_ee_pose({**given, "pose": converted})
        return replace(control, final_pose=hand_poses(control.final_pose))

    def step_waypoints(self, plan: object, max_misses: int | None = None) -> PlanControl:
        """Follow a plan of the hand."""
        assert isinstance(plan, SubtaskPlan), "the agent's own plans only"
        control = self.env.step_waypoints(
            plan._replace(poses=tool_poses(np.asarray(plan.poses))), max_misses=max_misses
        )
        return replace(control, final_pose=hand_poses(control.final_pose))

    def observe_objects(self, points: str = "surface", slots: npt.ArrayLike | None = None) -> Objects:
        """Ground truth with the pose of VoxPoser's hand, under the names that the instructions use."""
        seen = self.env.observe_objects(points, slots)
        return replace(seen, snapshot=tuple(each and view(each) for each in seen.snapshot))


def view(snapshot: ObjectsSnapshot) -> ObjectsSnapshot:
    """A snapshot of ``simpler/bridge`` with the pose of the hand, distances of its pads and spoken names."""
    return replace(
        snapshot,
        names=tuple(map(called, snapshot.names)),
        objects={called(name): cloud for name, cloud in snapshot.objects.items()},
        poses={called(name): pose for name, pose in snapshot.poses.items()},
        goal=tuple((verb, *map(called, things)) for verb, *things in snapshot.goal),
        targets=tuple(map(called, snapshot.targets)),
        movable=tuple(map(called, snapshot.movable)),
        scene=_with_table(snapshot),
        ee_pose=hand_poses(snapshot.ee_pose),
        gripper=_pads(snapshot.gripper),
    )


def _pads(fingers: np.ndarray) -> np.ndarray:
    """Distances of the pads from the middle [2], signed as Panda's, from the positions of WidowX's fingers."""
    left, right = np.maximum(fingers - PAD_OFFSET, 0.0)
    return np.array([left, -right])


def called(name: str) -> str:
    """The name of a model in the instructions."""
    return NAMES.get(name, name)


def tool_poses(poses: np.ndarray) -> np.ndarray:
    """Poses of the hand, [..., 7], as poses of WidowX's tool."""
    return _turned(poses, HAND_IN_TOOL.T)


def hand_poses(poses: np.ndarray) -> np.ndarray:
    """Poses of WidowX's tool, [..., 7], as poses of the hand."""
    return _turned(poses, HAND_IN_TOOL)


def _turned(poses: np.ndarray, turn: np.ndarray) -> np.ndarray:
    flat = np.asarray(poses, float).reshape(-1, 7)
    quats = np.array([quaternion(matrix(quat) @ turn) for quat in flat[:, 3:]])
    return np.concatenate([flat[:, :3], quats.reshape(-1, 4)], axis=1).reshape(np.shape(poses))


def _with_table(snapshot: ObjectsSnapshot) -> PointCloud:
    """The scene, with samples of the table added where it has none."""
    named = sum(len(cloud.points) for cloud in snapshot.objects.values())
    if len(snapshot.scene.points) > named:
        return snapshot.scene
    low = min(float(cloud.points[:, 2].min()) for cloud in snapshot.objects.values())
    ticks = np.arange(-_TABLE_HALF, _TABLE_HALF + _TABLE_STEP / 2, _TABLE_STEP)
    x, y = np.meshgrid(*(ticks + snapshot.workspace[:, axis].mean() for axis in (0, 1)))
    table = np.stack([x.ravel(), y.ravel(), np.full(x.size, low)], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (len(table), 1))
    scene = snapshot.scene
    return PointCloud(np.concatenate([scene.points, table]), np.concatenate([scene.normals, normals]))
