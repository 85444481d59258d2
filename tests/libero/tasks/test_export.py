"""An exported folder is all an environment needs, and gives the same episodes as the installed packages."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from typer.testing import CliRunner, Result

import vecenv
from vecenv.cli import COMMAND_GROUP, build_app
from vecenv.libero.env import LiberoEnv
from vecenv.libero.scene import goals
from vecenv.libero.tasks import settled
from vecenv.libero.tasks import suites as suite_list
from vecenv.libero.tasks.export import ExportError, ExportFolder, export
from vecenv.libero.tasks.seal import write_seal

SUITES = ("libero_goal", "libero_goal_task", "libero_10")
# Two scenes of libero_10; one of the tasks of libero_goal's single scene.
TASKS = {"libero_10": (0, 3), "libero_goal_task": (1,)}

ROLLOUT = """
import numpy as np
import vecenv

def rollout(suite, tasks, start, **options):
    env = vecenv.make(suite, tasks=tasks, episodes=[3], start=start, settle_steps=1, **options)
    states, rng = [], np.random.default_rng(0)
    for episodes in (3, 4):
        env.set_episodes(tasks=tasks[::-1], episodes=episodes)
        instructions = env.reset().instruction
        for _ in range(4):
            control = env.step_continuous(rng.uniform(-1, 1, (env.num_envs, 2, 7)))
            states.append((env.state(), control.success, env.check_success()))
    points = [snapshot.scene.points for snapshot in env.observe_objects().snapshot]
    env.close()
    arrays = [a for state, *verdicts in states for a in (state.qpos, state.qvel, state.time, *verdicts)]
    return instructions, [a.tobytes().hex() for a in (*arrays, *points)]
"""

WITHOUT_ASSETS = """
import json, sys
from vecenv.assets import AssetsMissing
folder, tasks = sys.argv[1], json.loads(sys.argv[2])
rollouts = [rollout(s, t, start, scenes=folder) for s, t in tasks.items() for start in ("settled", "raw")]
try:
    vecenv.make("libero_10", task=0)
except AssetsMissing:
    assert not {"libero", "robosuite"} & set(sys.modules)
    print(json.dumps(rollouts))
"""


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three suites, exported once; tests that damage it take a copy."""
    folder = tmp_path_factory.mktemp("export") / "libero"
    export(folder, SUITES)
    return folder


@pytest.fixture
def copy(exported: Path, tmp_path: Path) -> Path:
    """An export to damage; its scenes are those of libero_goal only."""
    folder = tmp_path / "copy"
    scenes = {task.scene_ids["exact"] for task in ExportFolder(exported).tasks("libero_goal")}
    for path in exported.rglob("*.*"):
        if path.parent.name != "scenes" or path.stem in scenes:
            (folder / path.relative_to(exported)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, folder / path.relative_to(exported))
    write_seal(folder)
    return folder


def make(folder: Path, suite: str = "libero_goal", **options: Any) -> LiberoEnv:
    env = vecenv.make(suite, **{"task": 0, "episodes": [0], "scenes": folder, **options})
    assert isinstance(env, LiberoEnv)
    return env


def compile_command(*arguments: str | Path) -> Result:
    compiling = EntryPoint("compile", "vecenv.libero.cli:compile_command", COMMAND_GROUP)
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app([compiling]), ["compile", *map(str, arguments)])


def test_without_any_assets_episodes_are_bit_identical_to_those_of_the_installed_packages(
    exported: Path, tmp_path: Path
) -> None:
    variables = ("VECENV_LIBERO_ROOT", "VECENV_LIBERO_ASSETS", "VECENV_ROBOSUITE_ASSETS")
    environment = {**os.environ, **dict.fromkeys(variables, str(tmp_path)), "VECENV_CACHE_DIR": ""}
    command = [sys.executable, "-c", ROLLOUT + WITHOUT_ASSETS, str(exported), json.dumps(TASKS)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    here: dict[str, Any] = {}
    exec(ROLLOUT, here)
    installed = [here["rollout"](s, list(t), start) for s, t in TASKS.items() for start in ("settled", "raw")]
    assert json.loads(done.stdout) == json.loads(json.dumps(installed))


@pytest.mark.parametrize("suite", SUITES)
def test_exported_tasks_are_those_of_the_installed_suite(exported: Path, suite: str) -> None:
    tasks, specs = ExportFolder(exported).tasks(suite), suite_list.list_tasks(suite)
    assert [(t.suite, t.index, t.name, t.instruction) for t in tasks] == [
        (s.suite, s.index, s.name, s.instruction) for s in specs
    ]
    for task, spec in zip(tasks, specs, strict=True):
        assert task.problem() == spec.problem()
        np.testing.assert_array_equal(task.init_states(), spec.init_states())
        np.testing.assert_array_equal(task.settled().qpos, settled.load(spec).qpos)
        np.testing.assert_array_equal(task.settled().qvel, settled.load(spec).qvel)


def test_a_scene_is_exported_once_with_the_contact_sensors_of_all_its_tasks(exported: Path) -> None:
    folder = ExportFolder(exported)
    tasks = [task for suite in ("libero_goal", "libero_goal_task") for task in folder.tasks(suite)]
    scenes = {id(task.scene(())) for task in tasks}
    assert len(scenes) == len({task.problem().scene_key() for task in tasks}) < len(tasks)
    for task in tasks:
        sharing = [t.problem() for t in tasks if t.scene_ids == task.scene_ids]
        assert task.scene(()).model.nsensor == len(goals.contact_pairs(sharing))
        goals.build_table([task.problem()], task.scene(()), [0])


def test_tasks_of_one_scene_keep_the_model_and_other_scenes_bring_their_own(exported: Path) -> None:
    env = make(exported, "libero_10", tasks=[0, 3], task=None)
    before = env.mj_models
    env.set_episodes(tasks=[3, 0])
    assert {id(model) for model in env.mj_models} == {id(model) for model in before}
    env.set_episodes(tasks=[1, 2])
    assert {model.nq for model in env.mj_models} != {model.nq for model in before}
    env.reset()


def test_several_suites_read_one_folder(exported: Path) -> None:
    assert ExportFolder(exported).suites == SUITES
    for suite in SUITES:
        assert make(exported, suite).reset().episode_id == (f"{suite}/0/0",)


def test_a_folder_may_be_given_as_text(exported: Path) -> None:
    assert vecenv.make("libero_goal", task=0, episodes=[0], scenes=str(exported)).reset().suite == "libero_goal"


# -- folders that cannot be used ---------------------------------------------------------------------------------------


def the_scene(folder: Path) -> Path:
    (task, *_) = ExportFolder(folder).tasks("libero_goal")
    return folder / "scenes" / f"{task.scene_ids['exact']}.mjb"


def edit_index(**changes: Any) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        path = folder / "index.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))

    return damage


def cut_the_index(folder: Path) -> None:
    path = folder / "index.json"
    path.write_bytes(path.read_bytes()[:-100])


def edit_a_task(folder: Path) -> None:
    path = folder / "index.json"
    index = json.loads(path.read_text())
    del index["suites"]["libero_goal"]["tasks"][2]["bddl"]
    path.write_text(json.dumps(index))


def cut_the_starts(folder: Path) -> None:
    path = folder / "starts" / "libero_goal.npz"
    path.write_bytes(path.read_bytes()[:-1])


def swap_the_starts(folder: Path) -> None:
    shutil.copy(folder / "starts" / "libero_10.npz", folder / "starts" / "libero_goal.npz")


def cut_the_scene(folder: Path) -> None:
    path = the_scene(folder)
    path.write_bytes(path.read_bytes()[:-1])


UNUSABLE = [
    (shutil.rmtree, r"no such folder; `vecenv compile --out .*` makes it"),
    (lambda folder: (folder / "index.json").unlink(), r"index\.json: cannot be read: No such file"),
    (cut_the_index, r"index\.json: damaged: not the index of an export; run `vecenv compile --out .*` again"),
    (edit_index(suites=["libero_goal"]), r"index\.json: damaged"),
    (edit_a_task, r"index\.json: damaged"),
    (edit_index(mujoco="3.16.1"), r"exported with MuJoCo 3\.16\.1, running .*; run `vecenv compile --out .*` again"),
    (edit_index(format=0), r"in layout 0, this vecenv reads layout \d+; run `vecenv compile --out .*` again"),
    (edit_index(suites={}), r"holds no suite 'libero_goal'; it holds none"),
    (lambda folder: (folder / "starts" / "libero_goal.npz").unlink(), r"libero_goal\.npz: not a part of the export"),
    (cut_the_starts, r"libero_goal\.npz: damaged: .*; run `vecenv compile"),
    (swap_the_starts, r"libero_goal\.npz: damaged: .*; run `vecenv compile"),
    (lambda folder: the_scene(folder).unlink(), r"\.mjb: not a part of the export .*; run `vecenv compile"),
    (cut_the_scene, r"\.mjb: damaged: .*; run `vecenv compile"),
]


@pytest.mark.parametrize(("damage", "says"), UNUSABLE)
def test_a_folder_that_cannot_be_used_says_which_file_and_what_to_do(
    copy: Path, damage: Callable[[Path], None], says: str
) -> None:
    make(copy).reset()
    damage(copy)
    with pytest.raises(
        ExportError, match=r"(index|seal)\.json|copy.*(missing|damaged|holds|no such|exported with|in layout)"
    ):
        make(copy).reset()
    if copy.is_dir():
        write_seal(copy)  # what was sealed damaged is found as well
    with pytest.raises(ExportError, match=says):
        make(copy).reset()


def flip(path: Path, where: float = 0.5) -> None:
    data = bytearray(path.read_bytes())
    data[int(where * (len(data) - 1))] ^= 1
    path.write_bytes(bytes(data))


def test_every_file_of_an_export_is_sealed(copy: Path) -> None:
    """One bit of any file, a file too many and a file too few are refused, and the file is named."""
    names = [path.relative_to(copy).as_posix() for path in copy.rglob("*") if path.is_file()]
    assert len(names) >= 6
    for name in names:
        good = (copy / name).read_bytes()
        flip(copy / name)
        if name != "starts/libero_10.npz" and name != "starts/libero_goal_task.npz":  # read by their own suites
            with pytest.raises(ExportError, match=re.escape(name)):
                make(copy).reset()
        (copy / name).write_bytes(good[:-1])
        with pytest.raises(ExportError, match=re.escape(name)):
            make(copy)
        (copy / name).unlink()
        with pytest.raises(ExportError, match=re.escape(name)):
            make(copy)
        (copy / name).write_bytes(good)
    for name in ("notes.txt", "starts/other.npz", f"scenes/{'0' * 64}.mjb", "images/index.json"):
        (copy / name).parent.mkdir(exist_ok=True)
        (copy / name).write_text("{}")
        with pytest.raises(ExportError, match=rf"{re.escape(name)}: not a part of the export"):
            make(copy)
        (copy / name).unlink()
    make(copy).reset()


@pytest.mark.parametrize(("name", "value"), [("qpos_0", np.nan), ("qvel_0", np.inf), ("raw_0", -np.inf)])
def test_starts_that_are_not_finite_are_refused(copy: Path, name: str, value: float) -> None:
    path, index_path = copy / "starts" / "libero_goal.npz", copy / "index.json"
    with np.load(path) as file:
        arrays = {each: file[each] for each in file.files}
    arrays[name][3, 9] = value
    np.savez_compressed(path, **arrays)
    index = json.loads(index_path.read_text())
    index["suites"]["libero_goal"]["starts"] = hashlib.sha256(path.read_bytes()).hexdigest()
    index_path.write_text(json.dumps(index))
    write_seal(copy)
    with pytest.raises(ExportError, match=rf"libero_goal\.npz: damaged: {name} of episode 3 is not finite"):
        make(copy, start="raw" if name == "raw_0" else "settled").reset()


def test_an_export_that_was_interrupted_is_no_export(copy: Path) -> None:
    (copy / "seal.json").unlink()
    with pytest.raises(ExportError, match=r"seal\.json: missing: the export was interrupted.*; run `vecenv compile"):
        make(copy)


def test_a_suite_that_was_not_exported_names_those_that_were(exported: Path) -> None:
    with pytest.raises(
        ExportError, match="holds no suite 'libero_90'; it holds libero_goal, libero_goal_task, libero_10"
    ):
        make(exported, "libero_90")


def test_lean_scenes_come_with_the_exact_ones_that_parts_are_measured_on(tmp_path: Path) -> None:
    export(tmp_path, ["libero_goal"], geometries=["lean"])
    env = make(tmp_path, geometry="lean")
    env.reset()
    (seen,) = env.observe_objects().snapshot
    assert seen is not None
    assert "wooden_cabinet_1_top_handle" in seen.parts


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command_writes_a_folder_that_make_reads(tmp_path: Path) -> None:
    done = compile_command("--out", tmp_path / "a" / "b", "--suite", "libero_goal", "--suite", "libero_goal_lan")
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("suites: 2, tasks: 20, scenes: 1, ")
    assert make(tmp_path / "a" / "b", "libero_goal_lan").reset().max_steps == [2500]


def test_an_export_may_be_written_again_and_one_that_was_interrupted_finished(copy: Path) -> None:
    assert compile_command("--out", copy, "--suite", "libero_goal").exit_code == 0
    assert ExportFolder(copy).suites == ("libero_goal",)
    (copy / "index.json").unlink()
    assert compile_command("--out", copy, "--suite", "libero_goal").exit_code == 0
    make(copy).reset()


def refused(arguments: Sequence[str | Path]) -> str:
    done = compile_command(*arguments)
    assert done.exit_code == 2
    assert done.stdout == ""
    return done.stderr


def test_the_command_refuses_what_it_would_spoil(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("draft")
    assert f"{tmp_path}: not an export, it holds thesis.tex" in refused(["--out", tmp_path])
    assert "not a folder" in refused(["--out", tmp_path / "thesis.tex"])
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_the_command_says_what_the_installed_packages_lack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(settled, "FOLDER", tmp_path / "nowhere")
    done = compile_command("--out", tmp_path / "out", "--suite", "libero_goal")
    assert (done.exit_code, done.stdout) == (1, "")
    assert "libero_goal.npz: no such file" in done.stderr
    assert not (tmp_path / "out" / "index.json").exists()


def test_the_command_refuses_a_suite_that_does_not_exist(tmp_path: Path) -> None:
    assert "unknown suite 'libero_goul': did you mean libero_goal" in refused(
        ["--out", tmp_path / "out", "--suite", "libero_goul"]
    )
    assert not (tmp_path / "out").exists()


def test_a_folder_names_the_mujoco_it_was_compiled_by(exported: Path) -> None:
    assert json.loads((exported / "index.json").read_text())["mujoco"] == mujoco.__version__
