"""Demonstration files: LIBERO's layout is understood, and nothing in a file is trusted."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.demo_files import FIXTURES, mjcf, replace, some_rollout, write
from vecenv_eval.demos.hdf5 import DemoError
from vecenv_eval.demos.options import make_options
from vecenv_eval.demos.read import read_demos
from vecenv_eval.demos.schema import Demo, MadeStart, Recording, StoredStart
from vecenv_eval.demos.write import write_demos

import vecenv
from vecenv.libero.tasks.suites import task as task_spec

SPEC = task_spec("libero_goal", 3)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Two demonstrations of libero_goal task 3."""
    return write(tmp_path / "some.hdf5", SPEC, [some_rollout(SPEC), some_rollout(SPEC, ticks=6, success=False)])


def edit(path: Path, change: Callable[[Any], object]) -> None:
    """Change a file's ``data``."""
    with h5py.File(path, "r+") as file:
        change(file["data"])


def reading(path: Path, **options: Any) -> list[Demo]:
    demos, bad = read_demos(path, **options)
    assert not bad, bad
    return demos


def stored(demo: Demo) -> StoredStart:
    assert isinstance(demo.start, StoredStart)
    return demo.start


# -- LIBERO's layout ---------------------------------------------------------------------------------------------------


def test_a_demonstration_is_its_task_start_actions_and_verdict(path: Path) -> None:
    first, second = reading(path)
    assert (first.suite, first.task, first.name, len(first), first.success) == ("libero_goal", 3, "demo_0", 4, True)
    assert (second.name, len(second), second.success) == ("demo_1", 6, False)
    np.testing.assert_array_equal(first.actions, np.full((4, 7), 0.1))
    np.testing.assert_array_equal(stored(first).state, SPEC.init_states()[0])


def test_fixtures_stand_where_the_mjcf_has_their_bodies(path: Path) -> None:
    turned = '<body name="x"><body name="flat_stove_1_main" pos="9 9 9"/></body>'
    text = mjcf(FIXTURES, turned).replace('"wine_rack_1_main"', '"wine_rack_1_main" quat="0 0 0 1"')
    edit(path, lambda data: data["demo_0"].attrs.modify("model_file", text))
    fixtures = stored(reading(path)[0]).fixtures
    assert fixtures is not None
    assert fixtures.keys() == FIXTURES.keys()
    np.testing.assert_array_equal(fixtures["flat_stove_1"][0], [-0.4, 0.2, 0.905])
    np.testing.assert_array_equal(fixtures["flat_stove_1"][1], [1, 0, 0, 0])
    np.testing.assert_array_equal(fixtures["wine_rack_1"][1], [0, 0, 0, 1])


def test_demonstrations_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    path = write(tmp_path / "many.hdf5", SPEC, [some_rollout(SPEC)] * 12)
    assert [demo.name for demo in reading(path)] == [f"demo_{i}" for i in range(12)]


def test_what_is_not_a_demonstration_is_passed_over(path: Path) -> None:
    edit(path, lambda data: data.create_group("notes"))
    assert [demo.name for demo in reading(path)] == ["demo_0", "demo_1"]


def test_without_an_init_state_the_first_state_is_the_start(path: Path) -> None:
    edit(path, lambda data: data["demo_0"].attrs.pop("init_state"))
    np.testing.assert_array_equal(stored(reading(path)[0]).state, SPEC.init_states()[0])


def test_without_an_mjcf_fixture_poses_are_unknown(path: Path) -> None:
    edit(path, lambda data: data["demo_0"].attrs.pop("model_file"))
    assert stored(reading(path)[0]).fixtures is None


def test_the_verdict_is_the_last_reward_or_else_the_last_done(path: Path) -> None:
    edit(path, lambda data: data["demo_0"].pop("rewards"))
    edit(path, lambda data: replace(data["demo_1"], "dones", np.ones(6)))
    assert [demo.success for demo in reading(path)] == [True, False]
    edit(path, lambda data: data["demo_0"].pop("dones"))
    assert [demo.success for demo in reading(path)] == [None, False]


def test_a_state_on_record_is_that_before_an_action(path: Path) -> None:
    rows = np.arange(4.0)[:, None] * np.ones(SPEC.init_states().shape[1])
    edit(path, lambda data: replace(data["demo_0"], "states", rows))
    demo = reading(path)[0]
    for ticks in range(4):
        np.testing.assert_array_equal(demo.recorded_state(ticks), rows[ticks])
    assert demo.recorded_state(4) is None


# -- which task --------------------------------------------------------------------------------------------------------


def found(path: Path, bddl: str | None, **options: Any) -> tuple[str, int]:
    def change(data: Any) -> None:
        for name in ("bddl_file_name", "env_args"):
            data.attrs.pop(name, None)
        if bddl is not None:
            data.attrs["bddl_file_name"] = bddl

    edit(path, change)
    demo = read_demos(path, **options)[0][0]
    return demo.suite, demo.task


def test_the_task_is_the_one_whose_task_file_is_named(path: Path) -> None:
    assert found(path, f"C:/x/{SPEC.name}.bddl") == ("libero_goal", 3)
    assert found(path, f"a/bddl_files/libero_goal_swap/{SPEC.name}.bddl") == ("libero_goal_swap", 3)
    assert found(path, f"a/bddl_files/libero_goal/{SPEC.name}.bddl", suite="libero_goal_lan") == ("libero_goal_lan", 3)
    assert found(path, "foreign.bddl", suite="libero_goal", task=4) == ("libero_goal", 4)


def test_the_task_may_be_in_env_args_or_in_the_name_of_the_file(path: Path) -> None:
    edit(path, lambda data: data.attrs.pop("bddl_file_name"))
    assert reading(path)[0].task == 3
    assert found(path.rename(path.with_name(f"{SPEC.name}_demo.hdf5")), None) == ("libero_goal", 3)


def test_a_foreign_task_is_refused_with_the_way_out(path: Path) -> None:
    with pytest.raises(DemoError, match=r"some\.hdf5: no task of any suite .*'foreign\.bddl'.*--suite and --task"):
        found(path, "bddl_files/libero_goal/foreign.bddl")


# -- damage ------------------------------------------------------------------------------------------------------------


def attribute(name: str, value: Any) -> Callable[[Any], object]:
    return lambda demo: demo.attrs.create(name, value)


def dataset(name: str, value: Any) -> Callable[[Any], object]:
    return lambda demo: replace(demo, name, value)


def link(name: str, target: Any) -> Callable[[Any], object]:
    def change(demo: Any) -> None:
        del demo[name]
        demo[name] = target

    return change


def external(demo: Any) -> None:
    del demo["actions"]
    demo.create_dataset("actions", (4, 7), float, external=[("other.bin", 0, 224)])


def huge_chunks(demo: Any) -> None:
    del demo["actions"]
    demo.create_dataset("actions", (4, 7), float, maxshape=(None, None), chunks=(1 << 20, 64))


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><mujoco><worldbody/></mujoco>'
NAN = np.where(np.arange(4)[:, None] == 2, np.nan, np.ones((4, 7)))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda demo: demo.pop("actions"), r"it has no dataset 'actions'"),
        (dataset("actions", np.zeros((4, 6))), r"actions: expected \[T, 7\] .* got \[4, 6\]"),
        (dataset("actions", np.zeros((0, 7))), r"actions: expected \[T, 7\] .* got \[0, 7\]"),
        (dataset("actions", 3.0), r"actions: expected \[T, 7\] .* got \[\]"),
        (dataset("actions", NAN), r"actions: row 2 is not finite"),
        (dataset("actions", np.full((4, 7), b"x")), r"actions: expected numbers, got \|S1"),
        (lambda demo: demo.pop("actions") and demo.create_group("actions"), r"'actions' is not a dataset"),
        (
            lambda demo: demo.pop("actions") and demo.create_dataset("actions", (10**12, 7), float),
            r"1000000000000, 7\]",
        ),
        (link("actions", h5py.ExternalLink("other.hdf5", "/x")), r"'actions' is a link to somewhere else"),
        (link("actions", h5py.SoftLink("/data/demo_1/actions")), r"'actions' is a link to somewhere else"),
        (external, r"actions: its numbers are in another file"),
        (huge_chunks, r"actions: its chunks of \[1048576, 64\] are too large"),
        (dataset("states", np.zeros((3, 79))), r"states: expected one row an action, \[4, 1 \+ nq \+ nv\], got \[3"),
        (dataset("rewards", np.zeros(3)), r"rewards: expected one number an action, \[4\], got \[3\]"),
        (attribute("success", "yes"), r"attribute success: expected true or false, got 'yes'"),
        (attribute("init_state", np.zeros(5)), r"init_state: 5 numbers, but a state of libero_goal task 3 has 79"),
        (attribute("init_state", np.full(79, np.inf)), r"init_state: holds a value that is not finite"),
        (attribute("init_state", "here"), r"attribute init_state: expected numbers"),
        (lambda d: (d.attrs.pop("init_state"), d.pop("states")), r"nothing says where it begins"),
        (attribute("model_file", "<mujoco>"), r"model_file: not well-formed XML"),
        (attribute("model_file", BOMB), r"model_file: it declares a document type"),
        (attribute("model_file", mjcf({})), r"model_file: no body wooden_cabinet_1_main, the fixture"),
        (attribute("model_file", mjcf(FIXTURES).replace("0.905", "nan")), r"pos='.* nan', expected 3 numbers"),
        (attribute("model_file", mjcf(FIXTURES).replace("-0.4 0.2", "__import__")), r"expected 3 numbers"),
        (attribute("model_file", mjcf(FIXTURES).replace("pos", "euler")), r"is turned by euler; MuJoCo saves quat"),
        (attribute("model_file", mjcf(FIXTURES).replace("pos", 'quat="0 0 0 0" pos')), r"quat has no length"),
        (attribute("model_file", 7), r"attribute model_file: expected text, got int64"),
        (attribute("make", "{"), r"attribute make: not JSON"),
        (attribute("make", "[" * 10_000), r"attribute make: not JSON"),
        (attribute("make", "[]"), r"attribute make: expected a JSON object, got list"),
        (attribute("make", '{"scenes": "elsewhere"}'), r"attribute make: 'scenes' is none of backend, contacts"),
        (attribute("make", '{"seed": "x"}'), r"attribute make: seed='x': expected int"),
        (attribute("make", '{"settle_steps": 999999999}'), r"settle_steps=999999999: more than 1,000"),
        (attribute("make", "{}"), r"attribute episode: expected 0 to 49, got None"),
    ],
)
def test_one_broken_demonstration_is_named_and_the_others_are_read(
    path: Path, change: Callable[[Any], object], says: str
) -> None:
    edit(path, lambda data: change(data["demo_0"]))
    demos, (bad,) = read_demos(path)
    assert [demo.name for demo in demos] == ["demo_1"]
    assert (bad.path, bad.name) == (path, "demo_0")
    assert re.search(says, bad.reason), bad.reason


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda data: [data.pop(name) for name in list(data)], r"its group 'data' holds no demonstrations"),
        (lambda data: data.file.move("data", "dada"), r"it has no group 'data'"),
        (lambda data: data.file.move("data/demo_0/actions", "x") or replace(data.file, "data", 1), r"is not a group"),
        (lambda data: link("data", h5py.ExternalLink("other.hdf5", "/data"))(data.file), r"'data' is a link"),
        (lambda data: data.attrs.create("bddl_file_name", 3), r"attribute bddl_file_name: expected text"),
        (lambda data: data.attrs.create("suite", "libero_x"), r"attribute suite: 'libero_x' is none of libero_spatial"),
        (lambda data: data.attrs.update(suite="libero_goal", task=10), r"attribute task: expected 0 to 9, got"),
    ],
)
def test_a_file_that_is_something_else_is_refused(path: Path, change: Callable[[Any], object], says: str) -> None:
    edit(path, change)
    with pytest.raises(DemoError, match=rf"some\.hdf5: .*{says}"):
        read_demos(path)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.5, 0.9, 0.99])
def test_a_file_cut_short_is_refused(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DemoError, match=r"some\.hdf5: not a readable HDF5 file"):
        read_demos(path)


def test_a_state_that_is_not_finite_is_said_when_it_is_asked_for(path: Path) -> None:
    states = np.repeat(SPEC.init_states()[:1], 4, axis=0)
    states[3, 5] = np.nan
    edit(path, lambda data: replace(data["demo_0"], "states", states))
    demo = reading(path)[0]
    assert demo.recorded_state(2) is not None
    with pytest.raises(DemoError, match=r"some\.hdf5: demo_0: states row 3: holds a value that is not finite"):
        demo.recorded_state(3)


# -- our own recordings ------------------------------------------------------------------------------------------------


def recording(episode: int, **fields: Any) -> Recording:
    width = SPEC.init_states().shape[1]
    values = {"actions": np.full((3, 7), 0.1 + episode), "success": True, "fault": "", **fields}
    values = {"init_state": np.zeros(width), "final_state": np.ones(width), **values}
    return Recording(episode=episode, options=make_options(vecenv.make, start="raw", seed=4), **values)


def test_what_is_written_reads_back(tmp_path: Path) -> None:
    states = np.random.default_rng(0).normal(size=(3, SPEC.init_states().shape[1]))
    path = tmp_path / "demos" / "own.hdf5"
    write_demos(path, "libero_goal", 3, "open it", [recording(7, states=states), recording(2, success=False)])
    second, seventh = reading(path)
    assert (second.suite, second.task, second.success, seventh.success) == ("libero_goal", 3, False, True)
    np.testing.assert_array_equal(seventh.actions, np.full((3, 7), 7.1))
    assert isinstance(seventh.start, MadeStart)
    assert seventh.start.episode == 7
    options = {"start": "raw", "seed": 4, "fixtures": "center", "settle_steps": 10}
    assert {name: seventh.start.options[name] for name in options} == options
    np.testing.assert_array_equal(seventh.recorded_state(1), states[1])
    np.testing.assert_array_equal(seventh.recorded_state(3), np.ones(states.shape[1]))
    assert second.recorded_state(1) is None


def test_readers_of_liberos_layout_find_what_they_look_for(tmp_path: Path) -> None:
    write_demos(tmp_path / "own.hdf5", "libero_goal", 3, "open it", [recording(0), recording(5)])
    with h5py.File(tmp_path / "own.hdf5") as file:
        data: Any = file["data"]
        assert data.attrs["bddl_file_name"] == f"bddl_files/libero_goal/{SPEC.name}.bddl"
        assert json.loads(data.attrs["problem_info"])["language_instruction"] == "open it"
        assert (data.attrs["num_demos"], data.attrs["total"]) == (2, 6)
        assert list(data["demo_5/dones"]) == list(data["demo_5/rewards"]) == [0, 0, 1]
        assert data["demo_5"].attrs["num_samples"] == 3


def test_later_recordings_are_added_and_replace_their_own_episode_only(tmp_path: Path) -> None:
    path = tmp_path / "own.hdf5"
    write_demos(path, "libero_goal", 3, "", [recording(0), recording(1)])
    write_demos(path, "libero_goal", 3, "", [recording(1, success=False), recording(2)])
    assert [(demo.name, demo.success) for demo in reading(path)] == [
        ("demo_0", True),
        ("demo_1", False),
        ("demo_2", True),
    ]
    assert [p.name for p in tmp_path.iterdir()] == ["own.hdf5"]


def test_a_write_that_fails_leaves_the_earlier_recordings(tmp_path: Path) -> None:
    path = tmp_path / "own.hdf5"
    write_demos(path, "libero_goal", 3, "", [recording(0)])
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_demos(path, "libero_goal", 3, "", [recording(1, fault=object())])
    assert path.read_bytes() == before
