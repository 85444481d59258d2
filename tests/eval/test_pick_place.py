"""The scripted policy: what it holds on to, in which order it works, and that it solves libero_object."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from vecenv_eval.policies.pick_place.goals import in_order
from vecenv_eval.policies.pick_place.motion import (
    CLOSE,
    Waypoint,
    WaypointFollower,
    rotation_matrices,
    rotation_vectors,
)
from vecenv_eval.policies.pick_place.policy import PickPlacePolicy

import vecenv
from vecenv.contract import BatchEnv, Metrics, ResetInfo
from vecenv.manipulation.grasps import Gripper, clearance, find_grasps
from vecenv.manipulation.placing import choose_grasp
from vecenv.manipulation.world import HOME_ROTATION, Margins, SceneGeometry, down_facing, yaw
from vecenv.observations import Egocentric, Objects, ObjectsSnapshot, PointCloud

Cloud = tuple[np.ndarray, np.ndarray]


def box(half: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0), count: int = 600) -> Cloud:
    """Points and normals of a box."""
    rng = np.random.default_rng(0)
    size = np.array(half)
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, count, p=areas / areas.sum())
    sign = rng.choice([-1.0, 1.0], count)
    points = rng.uniform(-1, 1, (count, 3)) * size
    points[np.arange(count), axis] = sign * size[axis]
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = sign
    return points + centre, normals


def ring(radius: float, wall: float, height: float, count: int = 800) -> Cloud:
    """Points and normals of an upright tube that stands on z = 0."""
    rng = np.random.default_rng(0)
    angle, outside = rng.uniform(0, 2 * np.pi, count), rng.choice([False, True], count)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    points = out * np.where(outside, radius, radius - wall)[:, None]
    points[:, 2] = rng.uniform(0, height, count)
    return points, out * np.where(outside, 1.0, -1.0)[:, None]


def snapshot(things: dict[str, Cloud], goal: tuple[tuple[str, ...], ...], **changes: Any) -> ObjectsSnapshot:
    """Things on a floor at z = 0, the hand half a metre above it."""
    floor = np.array([[x, y, 0.0] for x in np.linspace(-1, 1, 21) for y in np.linspace(-1, 1, 21)])
    clouds = {name: PointCloud(*cloud) for name, cloud in things.items()}
    everything = [*clouds.values(), PointCloud(floor, np.tile([0.0, 0.0, 1.0], (len(floor), 1)))]
    values: dict[str, Any] = {
        "names": tuple(things),
        "objects": clouds,
        "poses": {n: np.array([*c.points.mean(axis=0), 1.0, 0.0, 0.0, 0.0]) for n, c in clouds.items()},
        "regions": {},
        "goal": goal,
        "scene": PointCloud(*(np.concatenate([getattr(c, f) for c in everything]) for f in ("points", "normals"))),
        "ee_pose": np.array([0.0, 0.0, 0.5, 0.0, 1.0, 0.0, 0.0]),
        "gripper": np.array([0.04, -0.04]),
        "workspace": np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]]),
        "movable": tuple(things),
    }
    return ObjectsSnapshot(**{**values, **changes})


# -- grasps ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.2])
def test_a_box_is_pinched_across_its_narrower_side(angle: float) -> None:
    points, normals = box((0.06, 0.02, 0.03), (0, 0, 0.03))
    turn = rotation_matrices(np.array([[0.0, 0.0, angle]]))[0]
    grasps = find_grasps(points @ turn.T, normals @ turn.T)
    best = grasps.take(np.array([0]))
    assert abs(best.axis[0] @ turn[:, 1]) > 0.999
    assert best.width[0] == pytest.approx(0.04, abs=1e-3)
    np.testing.assert_allclose(best.pos[0, :2], 0, atol=0.01)


def test_fingertips_stay_above_the_ground_and_the_palm_above_the_object() -> None:
    gripper = Gripper()
    for height in (0.009, 0.06):
        grasps = find_grasps(*box((0.03, 0.02, height), (0, 0, height)))
        assert len(grasps)
        assert grasps.pos[:, 2].min() - gripper.tip > 0
        assert grasps.pos[:, 2].min() + gripper.palm > 2 * height


def test_a_bowl_is_held_by_its_rim_with_one_finger_inside() -> None:
    grasps = find_grasps(*ring(radius=0.055, wall=0.004, height=0.05))
    assert len(grasps)
    distance = np.linalg.norm(grasps.pos[0, :2])
    radial = grasps.pos[0, :2] / distance
    assert abs(radial @ grasps.axis[0, :2]) > 0.9
    assert grasps.width.max() < 0.02
    assert abs(distance - 0.053) < 0.025


def test_what_is_wider_than_the_hand_and_solid_offers_no_grasp() -> None:
    assert len(find_grasps(*box((0.06, 0.06, 0.03), (0, 0, 0.03)))) == 0


def test_clearance_is_negative_where_a_finger_would_hit() -> None:
    grasps = find_grasps(*box((0.02, 0.02, 0.03), (0, 0, 0.03))).take(np.array([0]))
    gripper = Gripper()
    middle = grasps.axis[0] * (gripper.half_opening + gripper.half_reach) / 2
    finger = grasps.pos[0] + middle
    assert clearance(grasps, finger[None])[0] < -0.005
    assert clearance(grasps, finger[None] - [0, 0, 0.05])[0] > 0.02
    beside = grasps.pos[0] + 0.08 * grasps.axis[0, [1, 0, 2]] * [-1.0, 1.0, 0.0]
    assert clearance(grasps, beside[None])[0] == pytest.approx(0.08 - gripper.palm_half[1])


def test_neighbours_turn_the_grasp_where_there_is_a_choice() -> None:
    target = box((0.02, 0.02, 0.03), (0, 0, 0.03))
    alone = choose_grasp(SceneGeometry(snapshot({"a": target}, ()), Margins()), "a")
    assert alone is not None
    axis = alone.rotation[:, 1]
    wall = [box((0.01, 0.01, 0.03), tuple(0.06 * sign * axis + [0, 0, 0.03])) for sign in (-1, 1)]
    between = choose_grasp(SceneGeometry(snapshot({"a": target, "b": wall[0], "c": wall[1]}, ()), Margins()), "a")
    assert between is not None
    assert abs(between.rotation[:, 1] @ axis) < 0.1


def test_a_hand_faces_down_and_turns_from_home_by_no_more_than_a_right_angle() -> None:
    angles = np.linspace(0, 2 * np.pi, 13)
    axes = np.stack([np.cos(angles), np.sin(angles), np.zeros(13)], axis=1)
    rotations = down_facing(axes)
    np.testing.assert_allclose(rotations[:, :, 2], np.tile([0.0, 0.0, -1.0], (13, 1)))
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    assert np.abs(yaw(rotations)).max() <= np.pi / 2 + 1e-9


# -- goals and motion --------------------------------------------------------------------------------------------------


def test_goals_are_worked_on_in_an_order_that_can_succeed() -> None:
    drawer = ("close", "cabinet_1_top_region"), ("in", "bowl_1", "cabinet_1_top_region")
    assert [p[0] for p in in_order(drawer)] == ["in", "close"]
    assert [p[0] for p in in_order((("close", "x_bottom"), ("open", "x_top")))] == ["close", "open"]
    stack = ("on", "bowl_1", "bowl_2"), ("in", "bowl_2", "tray_1_region")
    assert [p[1] for p in in_order(stack)] == ["bowl_2", "bowl_1"]
    pot = ("on", "pot_1", "stove_1_region"), ("turnon", "stove_1")
    assert [p[0] for p in in_order(pot)] == ["turnon", "on"]


def test_rotation_vectors_and_matrices_are_inverse() -> None:
    rng = np.random.default_rng(0)
    axis = rng.normal(size=(50, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    vectors = axis * rng.uniform(0, np.pi, (50, 1))
    vectors[0], vectors[1] = 0, [np.pi, 0, 0]
    again = rotation_vectors(rotation_matrices(vectors))
    np.testing.assert_allclose(rotation_matrices(again), rotation_matrices(vectors), atol=1e-6)


def test_slots_follow_their_waypoints_on_their_own() -> None:
    follower = WaypointFollower(3)
    near, far = np.array([0.05, 0.0, 0.0]), np.array([0.5, 0.0, 0.0])
    follower.load(0, [Waypoint(near, HOME_ROTATION, CLOSE)])
    follower.load(1, [Waypoint(near, HOME_ROTATION, CLOSE), Waypoint(far, HOME_ROTATION, CLOSE)])
    state = np.zeros((3, 8))
    state[:, 3] = np.pi
    for _ in range(40):
        action = follower.act(state)
        assert np.abs(action).max() <= 1
        state[:, :3] += 0.05 * action[:, :3]
    np.testing.assert_allclose(state[:, 0], [0.05, 0.5, 0.0], atol=0.02)
    assert follower.finished.all()
    assert (action[:, :6] == 0).all()
    np.testing.assert_array_equal(action[:, 6], [1, 1, -1])


# -- the policy --------------------------------------------------------------------------------------------------------


class StillEnv:
    """Shows snapshots and never moves."""

    def __init__(self, *snapshots: ObjectsSnapshot | None) -> None:
        self.snapshots, self.num_envs = snapshots, len(snapshots)

    def observe_objects(self, points: str = "surface", slots: Any = None) -> Objects:
        del points, slots
        return Objects(self.snapshots, ("",) * self.num_envs)

    def observe_egocentric(self, slots: Any = None) -> Egocentric:
        state = np.zeros((self.num_envs, 8), np.float32)
        state[:, 2:4] = 0.5, np.pi
        return Egocentric(state=state)

    def evaluate(self) -> Metrics:
        none = np.zeros(self.num_envs)
        return Metrics(none > 0, none.astype(int), "still", none.astype(int), none)


def test_goals_without_a_plan_are_reported_and_left_alone() -> None:
    cube = {"cube": box((0.02, 0.02, 0.02), (0.1, 0, 0.02))}
    env: Any = StillEnv(
        snapshot(cube, (("open", "oven"),)),
        snapshot(cube, (("on", "table", "cube"),), poses={"cube": np.zeros(7), "table": np.zeros(7)}),
        snapshot({"slab": box((0.1, 0.1, 0.01), (0, 0, 0.01)), **cube}, (("on", "slab", "cube"),)),
        None,
        snapshot({"base": box((0.05, 0.05, 0.01), (0.2, 0.2, 0.01)), **cube}, (("on", "cube", "base"),)),
    )
    policy = PickPlacePolicy()
    nothing = np.zeros(5, int)
    policy.reset(env, ResetInfo(("",) * 5, ("",) * 5, "still", nothing, nothing))
    actions = np.stack([policy.act(env) for _ in range(8)])
    reasons = dict(policy.unsupported)
    assert sorted(reasons) == [0, 1, 2, 3]
    assert "open" in reasons[0]
    assert "cannot be moved" in reasons[1]
    assert "nothing to hold" in reasons[2]
    assert "physics" in reasons[3]
    assert (actions[:, :4, :6] == 0).all()
    assert (actions[-1, 4, :3] != 0).any()


def rollout(env: BatchEnv, ticks: int) -> np.ndarray:
    """Actions of a fresh policy until every slot is done or for some ticks, [ticks, B, 7]."""
    policy, actions = PickPlacePolicy(), []
    policy.reset(env, env.reset())
    for _ in range(ticks):
        actions.append(policy.act(env))
        if env.step_continuous(actions[-1]).done.all():
            break
    return np.stack(actions)


def test_libero_object_is_solved_in_short_episodes() -> None:
    env = vecenv.make("libero_object", episodes=[7])
    try:
        rollout(env, 200)
        metrics = env.evaluate()
        assert metrics.success.sum() >= 9
        assert metrics.num_steps[metrics.success].mean() < 150
    finally:
        env.close()


def test_drawers_and_knobs_are_worked() -> None:
    env = vecenv.make("libero_90", tasks=[0, 7, 20], episodes=[0])  # close a drawer, open one, turn a stove on
    try:
        rollout(env, 160)
        assert env.evaluate().success.all()
    finally:
        env.close()


def test_actions_depend_on_the_episode_and_not_on_the_batch() -> None:
    alone = vecenv.make("libero_object", task=3, episodes=[1])
    together = vecenv.make("libero_object", task=3, episodes=[0, 1])
    try:
        first, second = rollout(alone, 40), rollout(together, 40)
        np.testing.assert_array_equal(first[:, 0], second[:, 1])
        assert not np.array_equal(second[:, 0], second[:, 1])
    finally:
        alone.close()
        together.close()
