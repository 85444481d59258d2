"""The verbs keep what ``vecenv.contract`` promises, on real LIBERO tasks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.libero_batch import STILL, make, put_target_in_basket, still, wiggle

import vecenv
from vecenv.actions import ActionError
from vecenv.contract import BatchEnv
from vecenv.libero.env import LiberoEnv, LiberoError
from vecenv.libero.scene import elements
from vecenv.libero.tasks import sources
from vecenv.observations import ImagesUnavailable
from vecenv.placement import PlacementError


@pytest.fixture
def env() -> Iterator[LiberoEnv]:
    env = make()
    env.reset()
    yield env
    env.close()


class TestReset:
    def test_returns_metadata_and_no_observation(self, env: LiberoEnv) -> None:
        info = env.reset()
        assert info.episode_id == ("libero_object/1/0", "libero_object/1/1", "libero_object/1/2")
        assert info.instruction[0] == "pick up the cream cheese and place it in the basket"
        assert info.suite == "libero_object"
        assert info.task_id.tolist() == [1, 1, 1]
        assert info.max_steps.tolist() == [2500, 2500, 2500]

    def test_leaves_live_slots_alone(self, env: LiberoEnv) -> None:
        env.step_continuous(wiggle(env))
        before = env.state()
        env.reset()
        after = env.state()
        np.testing.assert_array_equal(before.qpos, after.qpos)
        assert env.evaluate().num_steps.tolist() == [4, 4, 4]

    def test_rearms_a_finished_slot_in_place_and_disturbs_no_other(self) -> None:
        actions = np.random.default_rng(1).uniform(-1, 1, (3, 6, 7))
        alone, mixed = make(settle_steps=3), make(settle_steps=3)
        for env in (alone, mixed):
            env.reset()
            env.step_continuous(actions[:, :3])
        start = make(settle_steps=3)
        start.reset()
        put_target_in_basket(mixed, [1])
        # Slot 0 and 2 must not notice that slot 1 finishes here and is re-armed by the reset.
        control = mixed.step_continuous(actions[:, 3:4])
        assert control.terminated.tolist() == [False, True, False]
        mixed.reset()
        np.testing.assert_array_equal(mixed.state().qpos[1], start.state().qpos[1])
        assert mixed.evaluate().num_steps.tolist() == [4, 0, 4]
        mixed.step_continuous(actions[:, 4:])
        alone.step_continuous(actions[:, 3:])
        np.testing.assert_array_equal(mixed.state().qpos[[0, 2]], alone.state().qpos[[0, 2]])

    def test_must_come_before_stepping_and_observing(self) -> None:
        env = make()
        for verb in (lambda: env.step_continuous(still(env)), env.observe_egocentric, env.observe_objects, env.state):
            with pytest.raises(LiberoError, match=r"reset\(\)"):
                verb()

    def test_settling_does_not_count_as_steps(self) -> None:
        env = make(settle_steps=2)
        env.reset()
        assert env.evaluate().num_steps.tolist() == [0, 0, 0]
        np.testing.assert_allclose(env.state().time, 0.1)


class TestStepping:
    def test_a_chunk_equals_its_single_steps(self) -> None:
        chunked, single = make(), make()
        chunked.reset()
        single.reset()
        actions = wiggle(chunked)
        control = chunked.step_continuous(actions)
        for k in range(actions.shape[1]):
            single.step_continuous(actions[:, k])
        np.testing.assert_array_equal(chunked.state().qpos, single.state().qpos)
        assert control.step_index.tolist() == [4, 4, 4]
        assert control.info["ticks"].tolist() == [4, 4, 4]

    def test_a_chunk_stops_at_each_slots_own_terminal_tick(self, env: LiberoEnv) -> None:
        put_target_in_basket(env, [0])
        control = env.step_continuous(np.tile(STILL, (3, 5, 1)))
        assert control.terminated.tolist() == [True, False, False]
        assert control.info["ticks"].tolist() == [1, 5, 5]
        assert control.reward.tolist() == [1.0, 0.0, 0.0]

    def test_a_finished_slot_ignores_further_steps(self, env: LiberoEnv) -> None:
        put_target_in_basket(env, [0])
        env.step_continuous(still(env))
        before = env.state().qpos[0]
        control = env.step_continuous(wiggle(env))
        assert control.reward[0] == 0.0
        assert control.terminated[0]
        assert control.success[0]
        assert control.step_index.tolist() == [1, 5, 5]
        np.testing.assert_array_equal(env.state().qpos[0], before)
        metrics = env.evaluate()
        assert metrics.success.tolist() == [True, False, False]
        assert metrics.cumulative_reward.tolist() == [1.0, 0.0, 0.0]

    def test_the_budget_truncates(self) -> None:
        env = make(max_steps=2)
        env.reset()
        control = env.step_continuous(np.tile(STILL, (3, 5, 1)))
        assert control.truncated.all()
        assert not control.terminated.any()
        assert control.step_index.tolist() == [2, 2, 2]

    def test_success_at_the_last_tick_of_the_budget_is_success(self) -> None:
        env = make(max_steps=1)
        env.reset()
        put_target_in_basket(env, [2])
        control = env.step_continuous(still(env))
        assert control.terminated.tolist() == [False, False, True]
        assert control.truncated.tolist() == [True, True, False]

    def test_bad_numbers_are_mended_and_reported(self) -> None:
        env, clean = make(), make()
        env.reset()
        clean.reset()
        actions = np.zeros((3, 7))
        actions[0, 0], actions[1, 1], actions[1, 2] = np.nan, np.inf, -7.0
        control = env.step_continuous(actions)
        assert control.info["sanitized"].tolist() == [True, True, False]
        expected = np.zeros((3, 7))
        expected[1, 2] = -1.0
        assert not clean.step_continuous(expected).info["sanitized"].any()
        np.testing.assert_array_equal(env.state().qpos, clean.state().qpos)

    @pytest.mark.parametrize("bad", [np.zeros((2, 7)), np.zeros((3, 6)), np.zeros(7), "[[", [[1], [2, 3]], "ab"])
    def test_a_wrong_shape_names_what_is_right(self, env: LiberoEnv, bad: Any) -> None:
        with pytest.raises(ActionError, match=r"\[3, 7\]"):
            env.step_continuous(bad)
        assert env.evaluate().num_steps.tolist() == [0, 0, 0]

    def test_actions_may_be_json_text(self) -> None:
        text, array = make(episodes=[0]), make(episodes=[0])
        text.reset()
        array.reset()
        text.step_continuous("[0.5, 0, 0, 0, 0, 0, 1]")
        array.step_continuous(np.array([[0.5, 0, 0, 0, 0, 0, 1]]))
        np.testing.assert_array_equal(text.state().qpos, array.state().qpos)


class TestBatching:
    def test_a_slot_does_not_depend_on_its_neighbours(self) -> None:
        actions = np.random.default_rng(2).uniform(-1, 1, (5, 6, 7))
        batch, alone = make(episodes=range(5)), make(episodes=[3])
        batch.reset()
        alone.reset()
        batch.step_continuous(actions)
        alone.step_continuous(actions[3:4])
        np.testing.assert_array_equal(batch.state().qpos[3], alone.state().qpos[0])

    def test_results_are_bit_identical_at_any_thread_count(self) -> None:
        states = []
        for threads in (1, 2, 3):
            env = make(tasks=[0, 1], episodes=range(4), num_threads=threads)
            env.reset()
            env.step_continuous(wiggle(env))
            states.append(env.state().qpos)
        np.testing.assert_array_equal(states[0], states[1])
        np.testing.assert_array_equal(states[0], states[2])

    def test_tasks_of_different_scenes_share_a_batch(self) -> None:
        mixed = make(tasks=[4, 0], episodes=[0, 7])
        assert len(mixed.mj_models) == 2
        mixed.reset()
        actions = wiggle(mixed)
        mixed.step_continuous(actions)
        for slot, (task, episode) in enumerate([(4, 0), (4, 7), (0, 0), (0, 7)]):
            alone = make(task=task, episodes=[episode])
            alone.reset()
            alone.step_continuous(actions[slot : slot + 1])
            state = mixed.state()
            np.testing.assert_array_equal(state.qpos[slot, : state.nq[slot]], alone.state().qpos[0])

    def test_tasks_of_one_scene_share_a_model(self) -> None:
        env = make("libero_spatial", tasks=range(10), episodes=range(2))
        assert env.num_envs == 20
        assert env.mj_model is env.mj_models[0]
        assert len({spec.instruction for spec in vecenv.list_tasks("libero_spatial")}) == 10
        assert len(set(env.reset().instruction)) == 10

    def test_several_scenes_have_no_single_model(self) -> None:
        with pytest.raises(LiberoError, match="2 scenes"):
            _ = make(tasks=[0, 1]).mj_model


class TestPlacement:
    def test_episodes_of_tasks_fill_slots_task_by_task(self) -> None:
        info = make(tasks=[2, 0], episodes=[5, 6]).reset()
        assert info.episode_id == ("libero_object/2/5", "libero_object/2/6", "libero_object/0/5", "libero_object/0/6")

    def test_episodes_may_differ_between_tasks(self) -> None:
        info = make(tasks=[2, 0], episodes={2: [1], 0: [3, 4]}).reset()
        assert info.episode_id == ("libero_object/2/1", "libero_object/0/3", "libero_object/0/4")

    def test_set_episodes_places_and_reset_makes_live(self, env: LiberoEnv) -> None:
        env.step_continuous(still(env))
        env.set_episodes(tasks=3, episodes=[9, 8, 7])
        with pytest.raises(LiberoError, match=r"reset\(\)"):
            env.step_continuous(still(env))
        info = env.reset()
        assert info.episode_id == ("libero_object/3/9", "libero_object/3/8", "libero_object/3/7")
        fresh = make(task=3, episodes=[9, 8, 7])
        fresh.reset()
        np.testing.assert_array_equal(env.state().qpos, fresh.state().qpos)
        env.step_continuous(wiggle(env))
        fresh.step_continuous(wiggle(env))
        np.testing.assert_array_equal(env.state().qpos, fresh.state().qpos)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"tasks": [0, 10]}, "task 10"),
            ({"episodes": [50]}, "episode 50"),
            ({"episodes": []}, "empty"),
            ({"tasks": [0.5]}, "integer"),
            ({"tasks": ["zebra"]}, "cannot read 'zebra' as tasks"),
            ({"tasks": "pick_up"}, "'pick_up' fits 10"),
            ({"episodes": 3}, r"write \[3\] for episode 3 alone, or '3' for the first 3"),
        ],
    )
    def test_what_does_not_exist_is_named(self, options: dict[str, Any], message: str) -> None:
        with pytest.raises(PlacementError, match=message):
            make(**options)

    def test_a_wrong_number_of_episodes_is_refused(self, env: LiberoEnv) -> None:
        with pytest.raises(PlacementError, match="2 episodes for 3 slots"):
            env.set_episodes(episodes=[0, 1])

    @pytest.mark.parametrize("options", [{"backend": "cuda"}, {"start": "warm"}, {"geometry": "fat"}, {"max_steps": 0}])
    def test_an_option_that_does_not_exist_is_refused(self, options: dict[str, Any]) -> None:
        with pytest.raises(LiberoError, match=next(iter(options))):
            make(**options)


class TestFaults:
    def test_a_diverging_slot_is_quarantined_alone(self, env: LiberoEnv) -> None:
        healthy = make()
        healthy.reset()
        actions = wiggle(env)
        state = env.state()
        state.qvel[1, 20] = 1e30
        env.set_state(state)
        control = env.step_continuous(actions)
        healthy.step_continuous(actions)
        assert control.truncated.tolist() == [False, True, False]
        assert not control.success.any()
        assert [bool(reason) for reason in control.info["fault"]] == [False, True, False]
        assert "velocity" in control.info["fault"][1]
        np.testing.assert_array_equal(env.state().qpos[[0, 2]], healthy.state().qpos[[0, 2]])
        assert env.observe_objects().error[1]
        assert env.observe_objects().snapshot[1] is None

    def test_reset_revives_a_quarantined_slot(self, env: LiberoEnv) -> None:
        start = env.state().qpos
        state = env.state()
        state.qvel[1, 20] = 1e30
        env.set_state(state)
        env.step_continuous(still(env))
        env.reset()
        np.testing.assert_array_equal(env.state().qpos[1], start[1])
        assert env.step_continuous(still(env)).info["fault"] == ("", "", "")

    def test_exhausted_memory_is_a_fault(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a log file where the process stands.
        monkeypatch.setattr(elements, "ARENA_MEMORY", "230K")
        sources.compiled.cache_clear()
        try:
            env = make()
            env.reset()
            control = env.step_continuous(still(env))
        finally:
            sources.compiled.cache_clear()
        assert control.truncated.all()
        assert control.info["fault"] == ("constraint memory exhausted",) * 3

    def test_set_state_refuses_what_is_not_finite(self, env: LiberoEnv) -> None:
        state = env.state()
        state.qpos[2, 0] = np.nan
        with pytest.raises(LiberoError, match="slot 2"):
            env.set_state(state)


class TestObservations:
    def test_observing_changes_nothing(self) -> None:
        seen, unseen = make(), make()
        seen.reset()
        unseen.reset()
        for tick in range(3):
            actions = wiggle(seen, tick, 1)
            seen.step_continuous(actions)
            unseen.step_continuous(actions)
            seen.observe_objects()
            seen.observe_egocentric()
            seen.check_success()
        np.testing.assert_array_equal(seen.state().qpos, unseen.state().qpos)

    def test_a_finished_slot_shows_its_terminal_state(self, env: LiberoEnv) -> None:
        put_target_in_basket(env, [0])
        env.step_continuous(still(env))
        before = env.observe_egocentric().state[0]
        objects = env.observe_objects().snapshot[0]
        env.step_continuous(wiggle(env))
        np.testing.assert_array_equal(env.observe_egocentric().state[0], before)
        again = env.observe_objects().snapshot[0]
        assert objects is not None
        assert again is not None
        np.testing.assert_array_equal(objects.poses["cream_cheese_1"], again.poses["cream_cheese_1"])

    def test_state_is_there_and_asking_for_a_camera_that_is_not_is_an_error(self, env: LiberoEnv) -> None:
        observation = env.observe_egocentric()
        assert observation.state.shape == (3, 8)
        assert observation.state.dtype == np.float32
        with pytest.raises(ImagesUnavailable, match="no depth image of camera 'nowhere'"):
            observation.points_from_pixels("nowhere", np.zeros((1, 2), int))
        assert observation.pose is None

    def test_objects_carry_names_points_goal_and_bounds(self, env: LiberoEnv) -> None:
        snapshot = env.observe_objects().snapshot[0]
        assert snapshot is not None
        assert set(snapshot.objects) == set(snapshot.names) == set(snapshot.poses)
        assert snapshot.goal == (("in", "cream_cheese_1", "basket_1_contain_region"),)
        assert snapshot.targets == ("cream_cheese_1", "basket_1")
        for cloud in snapshot.objects.values():
            assert cloud.points.shape == cloud.normals.shape
            assert len(cloud.points) >= 200
            np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0)
        # The floor stands at 0 and so does the robot's base: bounds follow it.
        np.testing.assert_allclose(snapshot.workspace, [[-0.7, -0.4, -0.1], [0.3, 0.5, 0.35]])
        box = snapshot.regions["basket_1_contain_region"]
        assert box.parent == "basket_1"
        np.testing.assert_allclose(box.pos[:2], snapshot.poses["basket_1"][:2], atol=1e-3)

    def test_bounds_follow_the_robots_base(self) -> None:
        env = make("libero_goal", task=0)
        env.reset()
        snapshot = env.observe_objects().snapshot[0]
        assert snapshot is not None
        np.testing.assert_allclose(snapshot.workspace[:, 2], [0.812, 1.262])

    def test_box_points_bound_the_surface_points(self, env: LiberoEnv) -> None:
        surface, boxes = env.observe_objects().snapshot[1], env.observe_objects(points="aabb").snapshot[1]
        assert surface is not None
        assert boxes is not None
        for name, cloud in surface.objects.items():
            low, high = boxes.objects[name].points.min(0), boxes.objects[name].points.max(0)
            assert (cloud.points >= low - 1e-9).all()
            assert (cloud.points <= high + 1e-9).all()

    def test_an_unknown_kind_of_points_is_refused(self, env: LiberoEnv) -> None:
        with pytest.raises(LiberoError, match="surface"):
            env.observe_objects(points="voxels")


class TestSurfaceOfThePackage:
    def test_the_environment_speaks_the_contract(self, env: LiberoEnv) -> None:
        assert isinstance(env, BatchEnv)

    def test_a_closed_environment_says_so(self) -> None:
        env = make()
        env.reset()
        env.close()
        env.close()
        with pytest.raises(LiberoError, match="closed"):
            env.reset()

    def test_suites_and_tasks_are_listed(self) -> None:
        assert vecenv.list_suites()[:5] == ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")
        assert len(vecenv.list_suites("libero")) == 21
        assert len(vecenv.list_tasks("libero_90")) == 90
        metadata = vecenv.eval_metadata("libero_10")
        assert metadata["num_episodes"] == 500
        assert metadata["max_steps"] == 2500
        assert len(metadata["instructions"]) == 10

    def test_state_survives_a_round_trip(self, env: LiberoEnv) -> None:
        env.step_continuous(wiggle(env))
        state = env.state()
        env.step_continuous(wiggle(env, 1))
        env.set_state(state)
        again = env.state()
        np.testing.assert_array_equal(again.qpos, state.qpos)
        np.testing.assert_array_equal(again.qvel, state.qvel)
        np.testing.assert_array_equal(again.time, state.time)
