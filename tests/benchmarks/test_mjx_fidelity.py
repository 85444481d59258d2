"""The fidelity benchmark: what is recorded and replayed, what counts as agreement, and that a scene that fails costs
only itself."""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import mjx_fidelity
import numpy as np
import pytest
from fidelity import jobs, measures, recordings, rows, scenes, tables, workers
from fidelity.jobs import FIRST, IDLE, IDLE_TICKS, SECOND
from fidelity.recordings import GRACE, Recording
from fidelity.scenes import Ended

from vecenv.libero.env import SETTLE_ACTION
from vecenv.libero.scene.scene import compile_scene
from vecenv.libero.tasks.suites import list_tasks

OBJECTS = ("milk_1", "bowl_1")


def make_recording() -> Recording:
    """Tasks 0 and 2 with two episodes each: lengths 3, 1, 2, 4; the second and the last are not solved."""
    length = np.array([3, 1, 2, 4])
    start = np.zeros((4, 2, 3))
    return Recording(
        suite="libero_object",
        task=np.array([0, 0, 2, 2]),
        episode=np.array([0, 7, 0, 7]),
        length=length,
        success=np.array([True, False, True, False]),
        actions=np.arange(70, dtype=np.float32).reshape(10, 7) / 70,
        start=start,
        settled=start + [0.0, 0.0, -0.001],
        end=start + [0.1, 0.0, 0.0],
        notes={"cap": 400},
    )


def make_ended(**changes: Any) -> Ended:
    """Two slots that end as the recording's first two rows do."""
    fields: dict[str, Any] = {
        "qpos": np.zeros((2, 9)),
        "objects": np.tile([0.1, 0.0, 0.0], (2, 2, 1)),
        "ticks": np.array([3, 1]),
        "success": np.array([True, False]),
        "faults": {},
    }
    return Ended(**{**fields, **changes})


# -- recordings --------------------------------------------------------------------------------------------------------


def test_a_recording_survives_the_disk(tmp_path: Path):
    recording = make_recording()
    recording.save(tmp_path / "libero_object.npz")
    again = Recording.load(tmp_path, "libero_object")
    for name, value in vars(recording).items():
        np.testing.assert_array_equal(getattr(again, name), value)
    assert again.actions.dtype == np.float32


def test_a_missing_recording_is_named(tmp_path: Path):
    with pytest.raises(recordings.RecordingError, match=r"libero_goal\.npz: no such file.*record"):
        Recording.load(tmp_path, "libero_goal")


def test_an_episodes_actions_are_found_by_its_row():
    recording = make_recording()
    np.testing.assert_array_equal(recording.played(2), recording.actions[4:6])
    np.testing.assert_array_equal(recording.played(3), recording.actions[6:])


def test_rows_come_task_by_task_and_may_be_limited():
    recording = make_recording()
    assert recording.rows([2, 0]).tolist() == [2, 3, 0, 1]
    assert recording.rows([0, 2], 1).tolist() == [0, 2]


def test_a_shorter_recording_calls_late_successes_failures():
    short = make_recording().within(2)
    assert short.length.tolist() == [2, 1, 2, 2]
    assert short.success.tolist() == [False, False, True, False]
    np.testing.assert_array_equal(short.played(3), make_recording().played(3)[:2])
    assert np.isnan(short.end[[0, 3]]).all()
    assert np.isfinite(short.end[[1, 2]]).all()


def test_scenes_with_fewer_objects_are_joined_with_nan():
    one = make_recording()
    wide = np.ones((4, 3, 3))
    whole = recordings.joined([one, Recording(**{**vars(one), "start": wide, "settled": wide, "end": wide})])
    assert whole.start.shape == (8, 3, 3)
    assert np.isnan(whole.start[:4, 2]).all()
    assert np.isfinite(whole.start[:4, :2]).all()
    np.testing.assert_array_equal(whole.played(4), one.played(0))


@pytest.mark.parametrize(
    ("moving", "still", "kept"), [(5, 30, 5 + GRACE), (5, 3, 8), (0, 30, GRACE), (0, 1, 1)], ids=str
)
def test_a_failed_episode_ends_soon_after_the_last_new_action(moving: int, still: int, kept: int):
    actions = np.concatenate([np.arange(7.0 * moving).reshape(moving, 7) + 1, np.zeros((still, 7))])
    assert recordings.kept_length(actions) == kept


# -- what is replayed --------------------------------------------------------------------------------------------------


def test_slots_come_task_by_task_in_every_role():
    recording = make_recording()
    rows, roles = jobs.slots_of(recording.task, recording.rows([0, 2]), (IDLE, FIRST, SECOND))
    assert rows.tolist() == [0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3]
    assert roles.tolist() == [0, 0, 1, 1, 2, 2] * 2


def test_a_solved_episode_gets_time_after_its_end_and_a_failed_one_none():
    recording = make_recording()
    _, limit = jobs.commands(recording, np.array([0, 1, 2, 3]), np.full(4, FIRST))
    assert limit.tolist() == [3 + GRACE, 1, 2 + GRACE, 4]


def test_past_its_end_an_episode_holds_still_with_the_last_gripper_command():
    recording = make_recording()
    chunk, _ = jobs.commands(recording, np.array([2]), np.array([FIRST]))
    np.testing.assert_array_equal(chunk[0, :2], recording.played(2))
    assert not chunk[0, 2:, :6].any()
    assert (chunk[0, 2:, 6] == recording.played(2)[-1, 6]).all()


def test_idle_slots_hold_still_with_an_opening_gripper():
    chunk, limit = jobs.commands(make_recording(), np.array([0, 3]), np.full(2, IDLE))
    assert limit.tolist() == [IDLE_TICKS] * 2
    assert (chunk == SETTLE_ACTION).all()


# -- comparisons -------------------------------------------------------------------------------------------------------


def test_equal_verdicts_differ_nowhere():
    found = measures.verdicts(make_recording(), np.array([0, 1]), make_ended(), OBJECTS)
    assert (found["native"], found["here"], found["only native"], found["only here"]) == (1, 1, 0, 0)
    assert found["differ"] == []


def test_verdicts_are_compared_both_ways():
    objects = make_ended().objects.copy()
    objects[0, 1, 2] -= 0.25
    end = make_ended(success=np.array([False, True]), objects=objects, faults={0: "too many contacts"})
    found = measures.verdicts(make_recording(), np.array([0, 1]), end, OBJECTS)
    assert (found["only native"], found["only here"], found["faults"]) == (1, 1, {"too many contacts": 1})
    lost, won = found["differ"]
    assert (lost["task"], lost["episode"], lost["native"], lost["fault"]) == (0, 0, True, "too many contacts")
    assert (lost["object"], lost["metres"]) == ("bowl_1", pytest.approx(0.25))
    assert (won["episode"], won["native"], won["metres"]) == (7, False, 0.0)


def test_where_native_ended_is_not_known_of_an_episode_cut_short():
    recording = make_recording().within(2)
    found = measures.verdicts(recording, np.array([0]), scenes.part(make_ended(), np.array([True, False])), OBJECTS)
    assert found["differ"] == [{"task": 0, "episode": 0, "native": False, "fault": "", "object": "", "metres": None}]


def test_settling_measures_movement_here_in_native_and_the_distance_between():
    recording, start = make_recording(), np.zeros((2, 2, 3))
    objects = start.copy()
    objects[0, 1, 2] = -0.011
    found = measures.settling(recording, np.array([0, 1]), start, make_ended(objects=objects), OBJECTS)
    assert found["native"] == [0.001, 0.001, 0.001]
    assert found["here"][2] == pytest.approx(0.011)
    assert found["apart"] == pytest.approx([0.001, 0.0073, 0.01])
    assert found["worst"] == {"task": 0, "episode": 0, "object": "bowl_1"}
    assert (found["objects"], found["over 5 mm"]) == (4, 1)


def test_a_slot_that_failed_does_not_count_as_settled_elsewhere():
    objects = np.zeros((2, 2, 3))
    objects[0] = np.nan
    end = make_ended(objects=objects, faults={0: "non-finite"})
    found = measures.settling(make_recording(), np.array([0, 1]), np.zeros((2, 2, 3)), end, OBJECTS)
    assert found["apart"] == [0.001, 0.001, 0.001]
    assert (found["objects"], found["worst"]["episode"], found["faults"]) == (2, 7, {"non-finite": 1})


def test_two_runs_are_compared_where_they_took_as_long():
    other = make_ended(qpos=np.full((2, 9), 0.5), ticks=np.array([3, 2]), success=np.array([True, True]))
    found = measures.spread_of_runs(make_ended(), other)
    assert (found["episodes"], found["verdicts differ"], found["ticks differ"]) == (2, 1, 1)
    assert found["dqpos"] == [0.5, 0.5, 0.5]


def test_runs_that_never_took_as_long_have_no_distance():
    found = measures.spread_of_runs(make_ended(), make_ended(ticks=np.array([9, 9])))
    assert found["dqpos"] == []


def test_a_part_of_a_batch_keeps_the_faults_of_its_own_slots():
    end = scenes.part(make_ended(faults={0: "first", 1: "second"}), np.array([False, True]))
    assert end.faults == {0: "second"}
    assert end.healthy.tolist() == [False]


def test_object_columns_are_where_a_state_has_the_objects():
    spec = list_tasks("libero_object")[0]
    scene = compile_scene(spec.problem())
    columns = scenes.object_columns(scene)
    assert columns.shape == (len(scene.objects), 3)
    body = scene.model.body(scene.objects[3].root_body)
    np.testing.assert_array_equal(scene.model.qpos0[columns[3]], body.pos)


# -- jobs and workers --------------------------------------------------------------------------------------------------


def test_jobs_come_by_suite_and_scene_with_closed_loops_last():
    options = mjx_fidelity.arguments(
        ["compare", "here", "--suite", "libero_goal", "libero_object", "--closed-loop", "libero_goal"]
    )
    jobs = mjx_fidelity.jobs_of(options)
    assert [job.suite for job in jobs] == ["libero_object"] * 20 + ["libero_goal"] * 4
    assert [job.geometry for job in jobs[:2]] == ["exact", "lean"]
    assert [job.kind for job in jobs] == ["replay"] * 22 + ["closed"] * 2
    assert jobs[-1].tasks == tuple(range(10))
    assert len({job.key for job in jobs}) == len(jobs)


def test_a_scene_is_called_by_suite_task_and_upstreams_name():
    assert scenes.scene_name("libero_goal", [0, 1], ["open_the_drawer", "push"]) == "libero_goal/0"
    assert scenes.scene_name("libero_90", [4], ["KITCHEN_SCENE10_put_it"]) == "libero_90/4 kitchen_scene10"


def moody(what: str) -> dict[str, Any]:
    """Answer, raise, die or hang."""
    if what == "raise":
        raise ValueError("no such scene\nat all")
    if what == "die":
        os._exit(3)
    if what == "hang":
        time.sleep(60)
    return {"answer": what, "gpu": os.environ.get("CUDA_VISIBLE_DEVICES")}


def test_a_worker_outlives_what_goes_wrong_in_its_calls():
    worker = workers.Worker(moody, gpu=1)
    try:
        assert worker.call(("raise",), 60) == {"error": "ValueError: no such scene"}
        assert worker.call(("die",), 60) == {"error": "the process died with exit code 3"}
        assert worker.call(("fine",), 60) == {"answer": "fine", "gpu": "1"}
        assert worker.call(("hang",), 0.2) == {"error": "no result after 0 s"}
    finally:
        worker.close()


def test_a_scene_that_fails_is_a_row_and_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked: list[int] = []

    def answer(jobs: Any, setup: Any, options: argparse.Namespace) -> Any:
        asked.append(len(jobs))
        yield from ((job, {"error": "broken"} if job.tasks == (0,) else row_of(job.scene)) for job in jobs)

    monkeypatch.setattr(mjx_fidelity, "shared_out", answer)
    given = ["compare", str(tmp_path), "--suite", "libero_object", "--geometry", "exact", "--out", str(tmp_path)]
    for _ in range(2):
        mjx_fidelity.compare(mjx_fidelity.arguments(given))
    assert asked == [10, 1]
    rows = json.loads((tmp_path / "mjx_fidelity.json").read_text())["rows"]
    assert [row["scene"] for row in rows if "error" in row] == ["libero_object/0"]


def row_of(scene: str, **changes: Any) -> dict[str, Any]:
    """A row of results as ``perform`` returns it, with the job's own fields."""
    suite, task = scene.split("/")
    agreement = {"native": 9, "here": 8, "only native": 2, "only here": 1, "faults": {}}
    case = {"task": 0, "episode": 3, "native": True, "fault": "", "object": "milk_1", "metres": 0.2}
    settle = {"native": [0.0, 0.0, 0.0], "here": [0.0, 1e-4, 2e-3], "apart": [1e-6, 1e-4, 2e-3], "objects": 70}
    row = {
        "kind": "replay",
        "scene": scene,
        "suite": suite,
        "tasks": [int(task)],
        "backend": "warp",
        "geometry": "exact",
        "episodes": 10,
        "seconds": {"ready": 4.0, "first": 6.4},
        "ticks": 100,
        "settle": {**settle, "over 5 mm": 0, "worst": {"task": 0, "episode": 1, "object": "milk_1"}, "faults": {}},
        "replay": {**agreement, "differ": [case]},
        "twins": {"episodes": 10, "verdicts differ": 1, "ticks differ": 2, "dqpos": [1e-6, 1e-3, 0.1]},
        "again": None,
    }
    return {**row, **changes}


def test_results_files_are_merged_and_an_error_replaces_nothing(tmp_path: Path):
    good, failed = row_of("libero_object/0"), {**row_of("libero_object/0"), "error": "broken"}
    newer = row_of("libero_object/1", ticks=7)
    rows.write_rows(tmp_path / "one.json", [good, row_of("libero_object/1")])
    rows.write_rows(tmp_path / "two.json", [failed, newer])
    paths = [tmp_path / name for name in ("one.json", "none.json", "two.json")]
    assert rows.read_rows(paths) == [good, newer]


# -- tables ------------------------------------------------------------------------------------------------------------


def test_the_table_adds_up_a_suite():
    text = tables.markdown([row_of("libero_object/0"), row_of("libero_object/1")])
    assert "| libero_object | warp | exact | 2 | 18 → 16 of 20 | -10.0 | 4 / 2 | 0 of 140 | 2 of 20 | 0 |" in text
    assert "| libero_object | replay | warp | exact | only native | milk | 2 |" in text
    assert "0.001 / 0.1 / 2" in text
    assert "closed loop:" not in text


def test_the_table_names_what_was_not_compared():
    failed = {**row_of("libero_goal/0"), "error": "the process died with exit code 3"}
    clean = tables.markdown([row_of("libero_object/0")])
    assert "Not compared" not in clean
    text = tables.markdown([row_of("libero_object/0"), failed])
    assert "* replay libero_goal/0 warp exact: the process died with exit code 3" in text


def test_closed_loops_have_columns_of_their_own():
    closed = {**row_of("libero_object/0"), "kind": "closed"}
    closed["closed"] = {"native": 10, "here": 9, "only native": 1, "only here": 0, "faults": {"full": 1}, "differ": []}
    text = tables.markdown([row_of("libero_object/0"), closed])
    assert "10 → 9 of 10 | -10.0 | 1 / 0 |" in text
