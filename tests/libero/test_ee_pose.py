"""``step_ee_pose`` drives each slot to its own pose, within the limits of a tick."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from support.libero_batch import make

from vecenv.actions import ActionError
from vecenv.libero.env import LiberoEnv


@pytest.fixture
def env() -> Iterator[LiberoEnv]:
    env = make()
    env.reset()
    yield env
    env.close()


def _descent(start: np.ndarray) -> dict[str, np.ndarray]:
    """Three waypoints on the way down and to one side, the grip closing between the last two."""
    poses = np.repeat(start[:, None], 4, axis=1)
    poses[:, :, 0] += [0.03, 0.06, 0.06, 0.06]
    poses[:, :, 2] -= np.array([[0.01], [0.03], [0.05]]) * [1, 2, 2, 1]
    shape = poses.shape[:2]
    return {
        "poses": poses,
        "grip": np.tile([0, 0, 1, 1], (3, 1)),
        "hold": np.tile([0, 0, 5, 0], (3, 1)),
        "valid": np.ones(shape, bool),
    }


def _one(env: LiberoEnv, plan: dict[str, np.ndarray], t: int, carry: bool) -> np.ndarray:
    """Waypoint ``t`` of a plan in a call of its own; the ticks that it took, int [B]."""
    pose = np.concatenate([plan["poses"][:, t], plan["grip"][:, t, None]], axis=1)
    return env.step_ee_pose(pose, plan["hold"][:, t], carry=carry).step_count


class TestEePose:
    def test_slots_converge_each_on_its_own(self, env: LiberoEnv) -> None:
        start = env.step_ee_pose([]).final_pose
        target = np.concatenate([start, np.zeros((3, 1))], axis=1)
        target[:, 2] -= [0.0, 0.03, 0.09]
        control = env.step_ee_pose(target)
        assert control.converged.all()
        assert control.error == ("", "", "")
        assert 1 == control.step_count[0] < control.step_count[1] < control.step_count[2]
        assert (np.linalg.norm(control.final_pose[:, :3] - target[:, :3], axis=1) < 0.01).all()

    def test_no_tick_moves_further_than_allowed(self, env: LiberoEnv) -> None:
        start = env.step_ee_pose([]).final_pose
        target = np.concatenate([start, np.zeros((3, 1))], axis=1)
        target[:, 0] += 0.2
        control = env.step_ee_pose(target)
        travelled = np.linalg.norm(control.final_pose[:, :3] - start[:, :3], axis=1)
        assert (travelled <= 0.005 * control.step_count + 0.01).all()

    def test_an_empty_action_is_a_no_op(self, env: LiberoEnv) -> None:
        before = env.state().qpos
        control = env.step_ee_pose([])
        assert control.step_count.tolist() == [0, 0, 0]
        assert not control.done.any()
        np.testing.assert_array_equal(env.state().qpos, before)

    def test_hold_steps_close_the_gripper_without_motion(self, env: LiberoEnv) -> None:
        start = env.step_ee_pose([]).final_pose
        target = np.concatenate([start, np.ones((3, 1))], axis=1)
        control = env.step_ee_pose(target, hold_steps=[30, 0, 60])
        assert control.step_count.tolist() == [30, 1, 60]
        fingers = np.abs(env.observe_egocentric().state[:, 6:]).sum(axis=1)
        assert fingers[2] < 0.002
        assert fingers[1] > 0.03
        np.testing.assert_allclose(control.final_pose[:, :3], start[:, :3], atol=0.01)

    def test_pose_and_hold_may_come_as_a_mapping(self, env: LiberoEnv) -> None:
        start = env.step_ee_pose([]).final_pose
        target = np.concatenate([start, np.ones((3, 1))], axis=1)
        assert env.step_ee_pose({"pose": target, "hold_steps": 2}).step_count.tolist() == [2, 2, 2]

    def test_a_bad_pose_is_an_error_of_its_slot(self, env: LiberoEnv) -> None:
        start = env.step_ee_pose([]).final_pose
        target = np.concatenate([start, np.zeros((3, 1))], axis=1)
        target[:, 2] -= 0.03
        target[0, 3:7] = 0.0
        target[1, 0] = np.nan
        control = env.step_ee_pose(target)
        assert control.error == ("quaternion has no length", "pose is not finite", "")
        assert control.converged.tolist() == [False, False, True]
        assert control.step_count[0] == control.step_count[1] == 0

    def test_an_unknown_key_is_refused(self, env: LiberoEnv) -> None:
        with pytest.raises(ActionError, match="unknown key 'holds'; expected pose, hold_steps, carry, slots"):
            env.step_ee_pose({"pose": [], "holds": 2})

    @pytest.mark.parametrize("carry", ["yes", [True, False], 1])
    def test_carry_is_true_or_false_of_each_slot(self, env: LiberoEnv, carry: object) -> None:
        with pytest.raises(ActionError, match=r"^carry: .*true or false, or 3 of them"):
            env.step_ee_pose([], carry=carry)  # pyright: ignore[reportArgumentType]

    def test_slots_that_are_not_named_stand_still(self, env: LiberoEnv) -> None:
        start = env.step_ee_pose([]).final_pose
        target = np.concatenate([start, np.zeros((3, 1))], axis=1)
        target[:, 2] -= 0.03
        control = env.step_ee_pose({"pose": target, "slots": [1]})
        assert control.step_count[1] > 1
        assert control.step_count[[0, 2]].tolist() == [0, 0]
        assert control.error == ("", "", "")

    def test_waypoints_one_call_each_are_followed_as_in_one_plan_if_the_servo_carries_on(self) -> None:
        """The plan in one call, then the same waypoints one call each, with and without ``carry``."""
        ended, ticks = [], []
        for carry in (None, True, False):
            env = make()
            env.reset()
            plan = _descent(env.step_ee_pose([]).final_pose)
            if carry is None:
                spent = env.step_waypoints(plan).waypoint_ticks
            else:
                spent = np.stack([_one(env, plan, t, carry and t > 0) for t in range(4)], axis=1)
            ticks.append(spent)
            ended.append(env.state().qpos)
            env.close()
        np.testing.assert_array_equal(ticks[1], ticks[0])
        np.testing.assert_array_equal(ended[1], ended[0])
        assert (ticks[2].sum(axis=1) > ticks[0].sum(axis=1)).all()

    def test_there_is_nothing_to_carry_on_after_another_kind_of_step(self) -> None:
        ended = []
        for carry in (True, False):
            env = make()
            env.reset()
            plan = _descent(env.step_ee_pose([]).final_pose)
            _one(env, plan, 0, carry=False)
            env.step_continuous(np.zeros((3, 7)))
            _one(env, plan, 1, carry=carry)
            ended.append(env.state().qpos)
            env.close()
        np.testing.assert_array_equal(*ended)

    def test_a_grasp_lifts_a_real_object(self) -> None:
        env = make(episodes=[0], settle_steps=10)
        env.reset()
        snapshot = env.observe_objects().snapshot[0]
        assert snapshot is not None
        cheese = snapshot.objects["cream_cheese_1"].points
        centre = (cheese.min(0) + cheese.max(0)) / 2
        # Fingers close along the hand's y axis; this box is narrower along one horizontal side.
        spread = np.cov(cheese[:, :2].T)
        narrow = np.linalg.eigh(spread)[1][:, 0]
        yaw = np.arctan2(narrow[1], narrow[0]) - np.pi / 2
        down = np.array([0.0, np.cos(yaw / 2), np.sin(yaw / 2), 0.0])
        for height, grip, hold in ((0.12, 0, 0), (0.0, 0, 0), (0.0, 1, 20), (0.15, 1, 0)):
            pose = np.array([centre[0], centre[1], centre[2] + height, *down, grip])
            control = env.step_ee_pose(pose[None], hold_steps=hold)
            assert hold or control.converged.all()
        lifted = env.observe_objects().snapshot[0]
        assert lifted is not None
        assert lifted.poses["cream_cheese_1"][2] > snapshot.poses["cream_cheese_1"][2] + 0.08
