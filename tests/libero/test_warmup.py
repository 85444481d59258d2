"""``vecenv warmup`` makes scenes ready in processes of its own and says which are not."""

from __future__ import annotations

import json
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from vecenv.cli import COMMAND_GROUP, build_app
from vecenv.libero.tasks.export import export
from vecenv.libero.warmup import Warmup, WarmupError, scenes_of, usual_jobs, warm
from vecenv.placement import PlacementError
from vecenv.util import caching


def command(*arguments: str | Path) -> Result:
    warming = EntryPoint("warmup", "vecenv.libero.cli:warmup_command", COMMAND_GROUP)
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app([warming]), ["warmup", *map(str, arguments)])


def test_a_suite_has_as_many_scenes_as_it_has_models() -> None:
    assert scenes_of("libero_goal") == (0,)
    assert len(scenes_of("libero_object")) == 10
    assert len(scenes_of("libero_10")) == 9
    assert scenes_of("libero_object", "2,3") == (2, 3)
    with pytest.raises(PlacementError, match="99"):
        scenes_of("libero_object", "99")


def test_numbers_of_slots_are_checked() -> None:
    with pytest.raises(WarmupError, match=r"num_envs=\(0,\): need numbers of at least 1"):
        Warmup(suite="libero_goal", task=0, num_envs=(0,))
    assert usual_jobs() >= 1


def test_scenes_become_ready_and_the_one_that_does_not_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VECENV_CACHE_DIR", str(tmp_path / "cache"))
    lacking = {"scenes": str(tmp_path / "nowhere")}
    wanted = [
        Warmup(suite="libero_goal", task=0, num_envs=(1, 2)),
        Warmup(suite="libero_object", task=0, options=lacking),
    ]
    first, second = warm(wanted, jobs=2)
    assert (first.what, first.error) == (wanted[0], "")
    assert (tmp_path / "cache" / "scenes").is_dir()
    assert "no such folder" in second.error


def test_the_command_reads_a_compiled_folder_and_prints_lines_of_json(tmp_path: Path) -> None:
    export(tmp_path / "scenes", ["libero_goal"])
    given = ("--suite", "libero_goal", "--backend", "native", "--jobs", "1", "--json", "--scenes", tmp_path / "scenes")
    done = command(*given)
    assert done.exit_code == 0, done.output
    scene, end = (json.loads(line) for line in done.stdout.splitlines())
    assert (scene["event"], scene["suite"], scene["task"], scene["error"]) == ("scene", "libero_goal", 0, "")
    assert end == {"event": "end", "scenes": 1, "failed": 0}


def test_a_scene_that_is_not_ready_ends_the_command_with_status_1(tmp_path: Path) -> None:
    export(tmp_path, ["libero_goal"])
    done = command("--suite", "libero_goal", "--backend", "native", "--geometry", "lean", "--scenes", tmp_path)
    assert done.exit_code == 1
    assert "not ready: libero_goal 0: " in done.stderr
    assert "holds no lean scenes" in done.stderr
    assert done.stdout.startswith("0 of 1 scenes are ready")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--suite", "libero_goul"], "unknown suite 'libero_goul': did you mean libero_goal"),
        (["--suite", "libero_goal", "--images", "vulkan"], "unknown kind of images 'vulkan'"),
        (["--suite", "libero_goal", "--jobs", "0"], "--jobs 0: need at least 1"),
    ],
)
def test_the_command_refuses_what_it_cannot_do(arguments: list[str], says: str) -> None:
    done = command(*arguments)
    assert done.exit_code == 2
    assert says in done.stderr


def test_without_a_cache_there_is_nothing_to_fill(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(caching.VARIABLE, "")
    done = command("--suite", "libero_goal")
    assert done.exit_code == 2
    assert "turns the caches off" in done.stderr
