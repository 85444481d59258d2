"""From a program's calls to a batch of hands that move: requests, paths, subtasks, failures of one slot alone."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.voxposer_world import HOME, Obedient, box, handle, snapshot
from vecenv_eval.drive import drive
from vecenv_eval.policies import extras_of, make_policy

import vecenv
from vecenv.contract import BatchEnv
from vecenv.manipulation.routes import RouteConfig
from vecenv.observations import ObjectsSnapshot
from voxposer.agent import Agent, AgentConfig, PlannedMotion
from voxposer.interface import Interface
from voxposer.language.llm import Llm, LlmConfig
from voxposer.language.replies import LlmError, Reply
from voxposer.paths import obstacle_map, plan_paths
from voxposer.perception.config import HandState
from voxposer.perception.view import Perception
from voxposer.planning.config import PlannerConfig
from voxposer.pushing import PushError, PushingConfig, PushTask, arrived, next_pushes, situation
from voxposer.quaternions import euler2quat, pointat2quat, qinverse, qmult, quat2euler
from voxposer.requests import InterfaceError, MotionRequest
from voxposer.stops import along

CUBE = {"cube_1": box((0.02, 0.02, 0.02), (0.2, 0.1, 0.02))}


def begin(seen: ObjectsSnapshot | None = None, *, closed: bool = False) -> Interface:
    interface = Interface()
    interface.begin(Perception(seen or snapshot(CUBE), HandState(HOME, HOME, closed)))
    return interface


def target(interface: Interface, *voxel: int) -> Callable[[], np.ndarray]:
    volume = interface.functions()["get_empty_affordance_map"]()
    volume[tuple(voxel)] = 1
    return lambda: volume


# -- what programs call ------------------------------------------------------------------------------------------------


def test_maps_that_are_not_given_stay_at_the_present_state() -> None:
    interface = begin(closed=True)
    interface.execute(interface.detect("gripper"), target(interface, 70, 60, 30))
    request = interface.requests[0]
    np.testing.assert_allclose(request.rotation_at(np.array([1, 2, 3])), HOME[3:])
    assert request.velocity_at(np.zeros(3, int)) == 1
    assert request.closed_at(np.zeros(3, int))
    assert request.avoidance is None


def test_maps_are_evaluated_when_the_motion_is_asked_for() -> None:
    interface = begin()
    asked: list[int] = []

    def late() -> np.ndarray:
        asked.append(1)
        return target(interface, 70, 60, 30)()

    assert not asked
    interface.execute(lambda: interface.detect("gripper"), late)
    assert asked == [1]


def test_without_an_affordance_map_the_hand_stays_and_only_its_grip_changes() -> None:
    interface = begin()
    interface.execute(interface.detect("gripper"), gripper_map=np.zeros((100, 100, 100)))
    request = interface.requests[0]
    assert request.kind == "stay"
    assert request.closed_at_end(request.start)


def test_the_second_motion_starts_where_the_first_ends() -> None:
    interface = begin()
    interface.execute(interface.detect("gripper"), target(interface, 70, 60, 30))
    np.testing.assert_array_equal(interface.get_ee_pos(), [70, 60, 30])
    interface.execute(interface.detect("gripper"), gripper_map=np.zeros((100, 100, 100)))
    np.testing.assert_array_equal(interface.requests[1].start, [70, 60, 30])
    assert interface.functions()["get_empty_gripper_map"]().max() == 0  # the next map starts out closed


def test_a_subtask_begins_without_requests() -> None:
    interface = begin()
    interface.reset_to_default_pose()
    interface.begin(interface.perception)
    assert interface.requests == []


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"affordance_map": np.zeros((100, 100, 100))}, "no target"),
        ({"affordance_map": np.ones((10, 10, 10))}, r"affordance map has shape \(10, 10, 10\)"),
        ({"rotation_map": np.full((100, 100, 100, 4), np.nan)}, "rotation map holds values that are not finite"),
    ],
)
def test_invalid_maps_are_reported(arguments: dict[str, Any], says: str) -> None:
    interface = begin()
    with pytest.raises(InterfaceError, match=says):
        interface.execute(interface.detect("gripper"), **arguments)


def test_a_pushed_object_needs_a_target_and_must_be_movable() -> None:
    interface = begin(snapshot({**CUBE, "stove_1": box((0.1, 0.1, 0.02), (-0.2, 0, 0.02))}, fixed=("stove_1",)))
    with pytest.raises(InterfaceError, match="cube_1 is to move"):
        interface.execute(interface.detect("cube_1"))
    with pytest.raises(InterfaceError, match="stove_1 cannot be pushed"):
        interface.execute(interface.detect("stove_1"), target(interface, 70, 60, 30))


def request(gripper: np.ndarray, rotation: np.ndarray = HOME[3:]) -> MotionRequest:
    one = np.asarray(1.0)
    return MotionRequest("path", "gripper", False, np.zeros(3, int), None, None, None, rotation, one, gripper)


def test_a_path_that_ends_beside_the_marked_voxels_takes_their_grip() -> None:
    gripper = np.ones((100, 100, 100), np.float32)
    gripper[50, 50, 20] = 0
    asked = request(gripper)
    assert asked.closed_at_end(np.array([52, 50, 21]))
    assert not asked.closed_at_end(np.array([50, 50, 25]))
    assert not request(np.asarray(1.0)).closed_at_end(np.array([50, 50, 20]))


def test_a_grip_that_changes_near_the_end_changes_at_the_end() -> None:
    gripper = np.ones((100, 100, 100), np.float32)
    gripper[49:52, 49:52, 18:23] = 0
    path = np.array([[50, 50, z] for z in range(40, 19, -1)], float)
    stops = along(request(gripper), path, begin().perception)
    assert [s.closed for s in stops] == [False] * 20 + [True]
    assert stops[-1].final


def test_distances_in_centimetres_become_voxels_and_back() -> None:
    interface = begin()
    assert interface.cm2index(10, "x") == 10
    assert interface.cm2index(6, "z") == 10
    np.testing.assert_array_equal(interface.cm2index(10, np.array([0, -2.0, 0])), [0, -10, 0])
    assert interface.index2cm(10, "z") == pytest.approx(6)
    with pytest.raises(InterfaceError, match="'up'"):
        interface.cm2index(10, "up")


def test_setting_voxels_by_radius_stays_in_the_grid() -> None:
    interface = begin()
    volume = interface.set_voxel_by_radius(np.zeros((100, 100, 100)), [0, 99, 50], 3, 5)
    assert volume[0, 99, 50] == 5
    assert (np.argwhere(volume) == [3, 96, 45]).all(axis=1).any()
    assert not (np.argwhere(volume)[:, 0] > 3).any()


def test_quaternions_follow_the_convention_wxyz_world_frame() -> None:
    angles = [0.3, -0.4, 1.2]
    expected = Rotation.from_euler("xyz", angles).as_quat(scalar_first=True)
    np.testing.assert_allclose(euler2quat(*angles), expected, atol=1e-12)
    np.testing.assert_allclose(quat2euler(expected), angles, atol=1e-12)
    np.testing.assert_allclose(qmult(expected, qinverse(expected)), [1, 0, 0, 0], atol=1e-12)
    towards = np.array([0.3, 0.4, -0.5])
    turned = Rotation.from_quat(pointat2quat(towards), scalar_first=True)
    np.testing.assert_allclose(turned.apply([0, 0, 1]), towards / np.linalg.norm(towards), atol=1e-9)


# -- paths -------------------------------------------------------------------------------------------------------------


def test_several_slots_are_planned_together_as_they_are_alone() -> None:
    interfaces = [begin() for _ in range(3)]
    for i, interface in enumerate(interfaces):
        interface.execute(interface.detect("gripper"), target(interface, 60 + 10 * i, 40, 40))
    wants = [(interface, interface.requests[0]) for interface in interfaces]
    for interface in interfaces:
        interface.perception.move_hand(HOME[:3], np.diag([1.0, -1.0, -1.0]))
    together = plan_paths(wants, PlannerConfig(), RouteConfig())
    alone = [plan_paths([want], PlannerConfig(), RouteConfig())[0] for want in wants]
    for i, (a, b) in enumerate(zip(together, alone, strict=True)):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(np.round(np.asarray(a)[-1]), [60 + 10 * i, 40, 40])


def test_the_scene_is_an_obstacle_for_a_travelling_hand_but_not_a_pulling_one() -> None:
    bar = handle()
    held = snapshot(
        {"cabinet_1": box((0.1, 0.1, 0.11), (0.2, -0.02, 0.11)), "tower_1": box((0.04, 0.04, 0.2), (-0.3, 0.3, 0.2))},
        fixed=("cabinet_1",),
        parts={"cabinet_1_handle": bar},
        ee_pose=np.array([0.2, 0.1, 0.2, 0, 1, 0, 0]),
        gripper=np.array([0.008, -0.008]),
    )
    free, pulling = begin(), Interface()
    pulling.begin(Perception(held, HandState(held.ee_pose, HOME, closed=True)))
    assert pulling.perception.attached == "cabinet_1"
    for interface in (free, pulling):
        interface.execute(interface.detect("gripper"), target(interface, 70, 78, 50))
        interface.perception.move_hand(interface.perception.snapshot.ee_pose[:3], np.diag([1.0, -1.0, -1.0]))
    assert obstacle_map(free.perception, free.requests[0], RouteConfig()).any()
    assert not obstacle_map(pulling.perception, pulling.requests[0], RouteConfig()).any()


# -- the agent ---------------------------------------------------------------------------------------------------------


class Scripted(Llm):
    """A language model that has one reply for each LMP, by what the query says."""

    def __init__(self, replies: dict[str, str]) -> None:
        super().__init__(LlmConfig(model="scripted"))
        self.replies, self.asked = replies, []

    def complete(self, messages: Any, **options: Any) -> Reply:
        del options
        query = str(messages[-1]["content"]).splitlines()[-1]
        self.asked.append(query)
        for words, text in self.replies.items():
            if words in query:
                return Reply(
                    text=text, model="s", finish_reason="stop", prompt_tokens=3, completion_tokens=2, cost_usd=0.5
                )
        raise LlmError("scripted", f"no reply to {query}")


LIFT = """
hand = parse_query_obj('gripper')
where = get_affordance_map('above')
execute(hand, affordance_map=where)
"""
ABOVE = """
volume = get_empty_affordance_map()
x, y, z = parse_query_obj('gripper').position
volume[x, y, z + 5] = 1
ret_val = volume
"""
REPLIES = {
    "lift": 'composer("lift up")\ncomposer("lift up")',
    "lift up": LIFT,
    "gripper": "ret_val = detect('gripper')",
    "above": ABOVE,
    "break": 'composer("crash")',
    "crash": "nothing_like_this()",
}


def agent(
    env: Obedient, words: tuple[str, ...], on_planned: Callable[[PlannedMotion], None] | None = None, **options: Any
) -> tuple[Agent, Scripted]:
    llm = Scripted(dict(sorted(REPLIES.items(), key=lambda item: -len(item[0]))))
    config = AgentConfig(**{"passes": 1, **options})
    return Agent(cast(BatchEnv, env), words, llm, config, on_planned=on_planned), llm


def test_each_subtask_is_planned_on_the_present_state() -> None:
    env = Obedient(snapshot(CUBE))
    acting, _ = agent(env, ("lift",))
    acting.step()
    acting.step()
    ends = [plan.poses[0, np.flatnonzero(plan.valid[0])[-1], 2] for plan in env.plans]
    np.testing.assert_allclose(np.diff([HOME[2], *ends]), 0.03, atol=0.004)
    assert [int(plan.subtask[0, 0]) for plan in env.plans] == [0, 1]


def test_a_slot_whose_program_fails_does_not_stop_the_others() -> None:
    env = Obedient(snapshot(CUBE), snapshot(CUBE))
    acting, _ = agent(env, ("break", "lift"))
    acting.step()
    assert "crash" in acting.slots[0].cause
    assert "nothing_like_this" in acting.slots[0].cause
    assert not acting.slots[1].cause
    (plan,) = env.plans
    # The failed one holds still for as long as the other surely needs.
    assert plan.hold[0][plan.valid[0]].tolist() == [env.ticks[1]]
    assert not plan.grip[0][plan.valid[0]].any()
    assert acting.slots[0].counts.waypoints == 0
    np.testing.assert_array_equal(env.snapshots[0].ee_pose, HOME)
    assert env.snapshots[1].ee_pose[2] > HOME[2]


def test_a_slot_begins_another_episode_while_the_others_are_between_subtasks() -> None:
    env = Obedient(snapshot(CUBE), snapshot(CUBE))
    acting, _ = agent(env, ("break", "lift"))
    acting.step()
    before = acting.slots[1]
    env.snapshots[0] = snapshot({"plate_1": CUBE["cube_1"]})  # as a reset leaves the slot
    acting.begin(("lift", "lift"), [0])
    assert acting.slots[1] is before
    assert before.progress.begun == 1
    acting.step()
    assert [slot.progress.begun for slot in acting.slots] == [1, 2]
    assert not any(slot.cause for slot in acting.slots)
    assert "plate_1" in acting.slots[0].interface.perception.snapshot.objects


def test_an_unsolved_instruction_is_planned_again_up_to_the_pass_limit() -> None:
    env = Obedient(snapshot(CUBE), budget=400)
    llm = Scripted(dict(sorted(REPLIES.items(), key=lambda item: -len(item[0]))))
    acting = Agent(cast(BatchEnv, env), ("lift",), llm, AgentConfig(passes=2))
    control = acting.step()
    while not control.done.all():
        control = acting.step()
    assert acting.slots[0].progress.passes == 2
    assert acting.slots[0].progress.begun == 4
    assert acting.slots[0].cause == "followed to the end without success"


def test_a_solved_slot_is_left_alone() -> None:
    env = Obedient(snapshot(CUBE), solved_after=1)
    acting, llm = agent(env, ("lift",))
    assert acting.step().done.all()
    asked = len(llm.asked)
    acting.step()
    assert len(llm.asked) == asked
    assert acting.succeeded.all()


def test_the_policy_reports_what_an_episode_took() -> None:
    policy = make_policy("voxposer", passes=1)
    assert "offline/libero" in policy.name
    assert "rule-based" in policy.name
    env = Obedient(snapshot(CUBE), budget=300)
    acting, _ = agent(env, ("lift",))
    policy.agent = acting  # pyright: ignore[reportAttributeAccessIssue]
    list(drive(cast(BatchEnv, env), policy))
    said = extras_of(policy, 0)
    assert said["subtasks"] == 2
    assert said["questions"] == len(acting.slots[0].lmps.trace) > 3
    assert said["writer"] == "offline/libero, rule-based"  # the policy's own model
    assert (said["llm_cost_usd"], said["llm_tokens"]) == (0.5 * said["questions"], 5 * said["questions"])
    assert said["repairs"] == 0
    assert said["waypoints"] > 0
    assert said["cause"] == "followed to the end without success"


def test_maps_and_snapshots_are_freed_without_the_cycle_collector() -> None:
    env = Obedient(snapshot(CUBE), budget=300)
    acting, _ = agent(env, ("lift",))
    gc.collect()
    gc.disable()
    try:
        made: list[weakref.ref[np.ndarray]] = []
        for slot in acting.slots:
            filled = slot.interface._filled
            slot.interface._filled = lambda value, filled=filled: _followed(filled(value), made)  # type: ignore[method-assign]
        acting.step()
        assert made
        assert sum(array() is not None for array in made) == 0
        seen = weakref.ref(acting.slots[0].interface.perception)
        acting.close()
        assert seen() is None
    finally:
        gc.enable()


def _followed(array: np.ndarray, made: list[weakref.ref[np.ndarray]]) -> np.ndarray:
    made.append(weakref.ref(array))
    return array


# -- pushing -----------------------------------------------------------------------------------------------------------


def plate(x: float = 0.0) -> Perception:
    return begin(snapshot({"plate_1": box((0.07, 0.07, 0.02), (x, 0, 0.02))}), closed=True).perception


def test_a_push_comes_from_behind_and_starts_before_the_object() -> None:
    pushing = PushTask("plate_1", np.array([[0.2, 0.0, 0.02]]))
    (stops,) = next_pushes([situation(pushing, plate(), PushingConfig())], PushingConfig())
    xs = [stop.pos[0] for stop in stops]
    assert xs[0] == xs[1] < -0.07  # down before it
    assert xs[2] > xs[1] + 0.05  # through the contact
    assert all(stop.closed for stop in stops)
    assert min(stop.pos[2] for stop in stops) >= 0.02
    assert pushing.pushes == 1


def test_waypoints_that_the_object_has_passed_are_skipped() -> None:
    way = np.array([[0.05, 0, 0.02], [0.1, 0, 0.02], [0.3, 0, 0.02]])
    pushing = PushTask("plate_1", way)
    assert not arrived(pushing, plate(0.07))
    assert pushing.cursor == 1
    assert arrived(PushTask("plate_1", way), plate(0.295))
    assert arrived(PushTask("plate_1", way, pushes=PushingConfig().most), plate())


def test_a_failed_push_is_not_repeated() -> None:
    pushing = PushTask("plate_1", np.array([[0.2, 0.0, 0.02]]))
    before = situation(pushing, plate(), PushingConfig())
    next_pushes([before], PushingConfig())
    assert not arrived(pushing, plate(0.002))  # it hardly moved
    (vain,) = pushing.failed
    again = situation(pushing, plate(0.002), PushingConfig())
    touched = plate().snapshot.objects["plate_1"].points
    near = np.linalg.norm((touched - vain)[:, :2], axis=1) < 0.02
    assert before.free[near].any()
    assert not again.free[near].any()
    next_pushes([again], PushingConfig())
    assert not arrived(pushing, plate(0.05))
    assert pushing.failed == []


def test_an_object_against_a_wall_is_pushed_aside_first() -> None:
    wall = {"wall_1": box((0.005, 0.4, 0.15), (-0.082, 0, 0.15), 8000)}
    seen = begin(snapshot({"plate_1": box((0.07, 0.07, 0.02), (0, 0, 0.02)), **wall}, ("wall_1",))).perception
    found = situation(PushTask("plate_1", np.array([[0.45, 0.0, 0.02]])), seen, PushingConfig())
    assert abs(found.goal[1]) > 0.015
    assert found.free.any()


def test_an_object_enclosed_by_walls_cannot_be_pushed() -> None:
    walls = {
        f"wall_{i}": box((0.02, 0.2, 0.15) if i < 2 else (0.2, 0.02, 0.15), (*centre, 0.15), 4000)
        for i, centre in enumerate([(-0.1, 0), (0.1, 0), (0, -0.1), (0, 0.1)])
    }
    seen = begin(snapshot({"plate_1": box((0.07, 0.07, 0.02), (0, 0, 0.02)), **walls}, tuple(walls))).perception
    with pytest.raises(PushError, match="no room to begin a push of plate_1"):
        situation(PushTask("plate_1", np.array([[0.2, 0.0, 0.02]])), seen, PushingConfig())


@pytest.mark.heavy
def test_a_batch_ends_as_its_episodes_do_one_at_a_time() -> None:
    def run(episodes: list[int]) -> list[tuple[bool, int]]:
        env = vecenv.make("libero_object", task=0, episodes=episodes)
        policy = make_policy("voxposer")
        policy.reset(env, env.reset())
        for _ in drive(cast(BatchEnv, env), policy):
            pass
        found = env.evaluate()
        env.close()
        return list(zip(found.success.tolist(), found.num_steps.tolist(), strict=True))

    together = run([0, 1, 2])
    assert together == [run([episode])[0] for episode in (0, 1, 2)]
    assert all(success for success, _ in together)


@pytest.mark.heavy
def test_pushing_language_moves_the_plate_by_pushes() -> None:
    env = vecenv.make("libero_goal", task=5, episodes=[0])
    policy = make_policy("voxposer")
    policy.reset(env, env.reset())
    for _ in drive(cast(BatchEnv, env), policy):
        pass
    assert env.evaluate().success.all()
