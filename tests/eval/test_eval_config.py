"""Settings of an evaluation: the same ones in Python, in YAML and on the command line."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import vecenv_eval
from support.fakes import SUITE, FakeWorld
from typer.testing import CliRunner, Result
from vecenv_eval import runner
from vecenv_eval.config import ConfigError, EvalConfig, option_name, setting

from vecenv.cli import build_app


def invoke(*arguments: str) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), ["eval", *arguments])


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeWorld:
    world = FakeWorld()
    monkeypatch.setattr(runner, "vecenv_simulator", lambda: world.simulator)
    monkeypatch.chdir(tmp_path)
    return world


def stored(folder: str) -> dict[str, Any]:
    return json.loads((Path(folder) / "config.json").read_text())["config"]


def test_every_field_has_its_sentence_and_its_option() -> None:
    help = invoke("--help").stdout
    for field in dataclasses.fields(EvalConfig):
        assert setting(field).help.endswith("."), field.name
        assert option_name(field) in help, field.name


def test_a_config_survives_yaml(tmp_path: Path) -> None:
    config = EvalConfig(
        suite="libero_goal",
        policy="random",
        policy_args={"hold": 3, "nested": {"a": [1, 2]}},
        episodes=(0, 4),
        max_steps=7,
        record=True,
    )
    config.save(tmp_path / "deep" / "eval.yaml")
    assert EvalConfig.load(tmp_path / "deep" / "eval.yaml").to_dict() == {**config.to_dict(), "episodes": [0, 4]}


def test_yaml_needs_only_what_differs_and_numbers_may_stand_for_text(tmp_path: Path) -> None:
    (tmp_path / "eval.yaml").write_text("suite: simpler/bridge\nepisodes: 5\ntasks: 2\n")
    config = EvalConfig.load(tmp_path / "eval.yaml")
    assert (config.episodes, config.tasks, config.policy_name) == ("5", "2", "simpler_scripted")
    assert config == EvalConfig(suite="simpler/bridge", episodes="5", tasks="2")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("suite: s\nmax_step: 3", "unknown setting 'max_step': did you mean max_steps"),
        ("suite: s\nmax_steps: many", "max_steps: .*integer"),
        ("suite: s\npolicy_args: [1]", "policy_args: .*dictionary"),
        ("suite: s\nnum_envs: 0", "num_envs must be at least 1, not 0"),
        ("tasks: all", "suite: .*required"),
        ("- suite", "expected settings such as"),
        ("suite: [", "cannot be read"),
    ],
)
def test_a_file_that_makes_no_config_says_why(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "eval.yaml").write_text(text)
    with pytest.raises(ConfigError, match=says):
        EvalConfig.load(tmp_path / "eval.yaml")


def test_options_override_the_file(world: FakeWorld) -> None:
    text = f"suite: {SUITE}\npolicy: zero\nmax_steps: 5\nrecord: true\npolicy_args: {{gripper: 0.5}}\n"
    Path("eval.yaml").write_text(text)
    done = invoke("--config", "eval.yaml", "--max-steps", "3", "--no-record", "--out", "here")
    assert done.exit_code == 0, done.output
    found = stored("here")
    assert (found["suite"], found["max_steps"], found["record"]) == (SUITE, 3, False)
    assert found["policy_args"] == {"gripper": 0.5}
    assert {env.max_steps for env in world.envs} == {3}


def test_a_file_with_a_mistake_gets_one_line_and_status_2(world: FakeWorld) -> None:
    Path("eval.yaml").write_text("suite: s\ncolour: red\n")
    for arguments in (["--config", "eval.yaml"], ["--config", "nowhere.yaml"], ["--resume", "r", "--config", "e"]):
        done = invoke(*arguments)
        assert done.exit_code == 2
        assert len(done.stderr.splitlines()) == 1
    assert not Path("results").exists()


def test_a_config_is_all_that_evaluate_needs(world: FakeWorld) -> None:
    result = vecenv_eval.evaluate(vecenv_eval.EvalConfig(suite=SUITE, policy="zero", tasks="0"))
    assert result.ok
    assert result.folder.parent == Path("results")
    assert vecenv_eval.evaluate(EvalConfig(suite=SUITE, policy="zero", tasks="0"), Path("here")).folder == Path("here")


def test_a_number_below_its_minimum_is_refused() -> None:
    with pytest.raises(ConfigError, match="max_steps must be at least 1, not 0"):
        EvalConfig(suite=SUITE, max_steps=0)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("cameras: agentview", ("agentview",)),
        ("cameras: agentview, wrist", ("agentview", "wrist")),
        ("cameras: [wrist, 'agentview,frontview', wrist]", ("wrist", "agentview", "frontview")),
        ("", ()),
    ],
)
def test_cameras_are_a_list_or_a_text_with_commas(tmp_path: Path, text: str, names: tuple[str, ...]) -> None:
    (tmp_path / "eval.yaml").write_text(f"suite: libero_goal\n{text}\n")
    config = EvalConfig.load(tmp_path / "eval.yaml")
    assert config.camera_names == names
    config.save(tmp_path / "again.yaml")
    assert EvalConfig.load(tmp_path / "again.yaml").camera_names == names


@pytest.mark.parametrize("cameras", ["", " , ", []])
def test_no_camera_is_refused(cameras: Any) -> None:
    with pytest.raises(ConfigError, match="no camera is named"):
        EvalConfig(suite="libero_goal", cameras=cameras)


def test_the_option_for_cameras_is_repeatable(tmp_path: Path) -> None:
    done = invoke("--suite", "libero_goal", "--cameras", "wrist", "--cameras", "agentview,nowhere")
    assert done.exit_code == 2
    assert "error: libero_goal task 0: there is no camera 'nowhere'; cameras: frontview, birdview" in done.stderr


class Sees:
    """A policy that reads one camera."""

    name = "sees"

    def __init__(self, camera: str) -> None:
        self.camera = camera

    def needed_cameras(self) -> list[str]:
        return [self.camera]

    def reset(self, env: Any, info: Any) -> None: ...

    def act(self, env: Any) -> Any: ...


@pytest.mark.parametrize(
    ("camera", "cameras", "says"),
    [
        ("wrist", "agentview", "reads camera 'wrist'; libero_goal task 0 has agentview here"),
        ("sideview", None, None),
        ("nowhere", None, "reads camera 'nowhere'; libero_goal task 0 has frontview, birdview"),
        ("robot0_eye_in_hand", "wrist", None),
    ],
)
def test_a_policy_that_would_not_get_its_images_is_refused_before_anything_runs(
    camera: str, cameras: str | None, says: str | None
) -> None:
    policy = {"policy": f"{__name__}:Sees", "policy_args": {"camera": camera}}
    config = EvalConfig(suite="libero_goal", tasks="0", cameras=cameras, **policy)
    if says is None:
        runner.Evaluation(config)
        return
    with pytest.raises(ConfigError, match=says):
        runner.Evaluation(config)
