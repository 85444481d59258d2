"""Reach of the Panda: forward kinematics as MuJoCo's, inverse kinematics that it confirms, limits that hold."""

from __future__ import annotations

import numpy as np

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.manipulation.reach import LOWER, UPPER, PandaArm, hand_of
from vecenv.manipulation.world import HOME_ROTATION, matrix

BASE = np.array([-0.6, 0.1, 0.9, np.cos(0.2), 0.0, 0.0, np.sin(0.2)])


def test_the_hand_is_where_mujoco_has_it() -> None:
    env = vecenv.make("libero_goal", task=0, episodes=[0, 1])
    assert isinstance(env, LiberoEnv)
    with env:
        env.reset()
        env.step_continuous(np.tile([0.3, -0.5, -0.4, 0.2, 0.1, 0.3, -1.0], (2, 12, 1)))
        for qpos, seen in zip(env.state().qpos, env.observe_objects().snapshot, strict=True):
            assert seen is not None
            assert seen.panda_base is not None
            position, rotation = hand_of(qpos[:7])
            np.testing.assert_allclose(position + seen.panda_base[:3], seen.ee_pose[:3], atol=1e-5)
            np.testing.assert_allclose(rotation, matrix(seen.ee_pose[3:]), atol=1e-3)


def test_poses_of_possible_joint_angles_are_found_and_the_angles_lead_there() -> None:
    arm, turn = PandaArm(BASE), matrix(BASE[3:])
    joints = np.random.default_rng(0).uniform(LOWER, UPPER, (200, 7))
    hands = [hand_of(each) for each in joints]
    positions = np.array([BASE[:3] + turn @ position for position, _ in hands])
    found, solved = arm.solve(positions, np.array([turn @ rotation for _, rotation in hands]))
    assert found.mean() > 0.9
    assert ((solved >= LOWER) & (solved <= UPPER)).all()
    for position, angles in zip(positions[found], solved[found], strict=True):
        assert np.linalg.norm(BASE[:3] + turn @ hand_of(angles)[0] - position) <= arm.within[0]


def test_a_hand_that_points_down_reaches_the_table_but_not_beyond_nor_the_base() -> None:
    places = np.array([[0.45, 0.0, 0.1], [0.5, 0.3, 0.1], [1.0, 0.0, 0.1], [0.05, 0.0, 0.1], [0.4, 0.0, 1.3]])
    reached = PandaArm(np.array([0.0, 0, 0, 1, 0, 0, 0])).reaches(places, np.tile(HOME_ROTATION, (5, 1, 1)))
    assert reached.tolist() == [True, True, False, False, False]
