"""``vecenv voxposer run``: a sentence of one's own in the scene of a task, what it prints and its exit status."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from support.images import needs_gl
from support.llm_server import LlmServer, failure, serving
from support.voxposer_models import CUBE, Writer
from support.voxposer_world import Obedient, snapshot
from typer.testing import CliRunner, Result
from vecenv_eval.cli.options import pairs
from vecenv_eval.cli.voxposer import voxposer_app
from vecenv_eval.sentence import follow

pytest.importorskip("litellm", reason="the extra voxposer is not installed")

import vecenv
from vecenv.contract import ResetInfo


class Scene(Obedient):
    """One slot of libero_goal/8 with a cube and an obedient hand."""

    control_hz = 20.0
    solved_after: int | None = None

    def __init__(self) -> None:
        super().__init__(snapshot(CUBE), budget=500, solved_after=Scene.solved_after)

    def reset(self) -> ResetInfo:
        return ResetInfo(
            ("put the bowl on the plate",), ("libero_goal/8/0",), "libero_goal", np.array([8]), np.array([500])
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...


@pytest.fixture(scope="module")
def server() -> Iterator[LlmServer]:
    with serving() as running:
        yield running


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What scenes were made with."""
    made: list[dict[str, Any]] = []

    def make(suite: str, **arguments: Any) -> Scene:
        made.append({"suite": suite, **arguments})
        return Scene()

    monkeypatch.setattr(vecenv, "make", make)
    monkeypatch.setattr(Scene, "solved_after", None)
    monkeypatch.setenv("OPENAI_API_KEY", "k")
    return made


def invoke(*arguments: str) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(voxposer_app, ["run", *arguments])


def of(server: LlmServer) -> list[str]:
    options = [f"api_base={server.base}", "cache=false", "attempts=1"]
    return ["--model", "openai/local", *(word for each in options for word in ("--policy-arg", each))]


def test_another_sentence_is_followed_once_and_has_no_verdict(server: LlmServer, scene: list[dict[str, Any]]) -> None:
    Writer(server, {"Raise your hand": 'composer("lift up")\ncomposer("lift up")'})
    done = invoke("libero_goal/8", "Raise  your hand.", "--episode", "3", *of(server))
    assert done.exit_code == 0, done.output
    assert scene == [{"suite": "libero_goal", "task": 8, "episodes": [3]}]
    lines = done.stdout.splitlines()
    assert lines[:4] == ["subtasks:", "  1. lift up", "  2. lift up", "done:"]
    assert [line.split(":")[0] for line in lines[4:6]] == ["  lift up"] * 2
    assert "programs by: openai/local" in lines
    assert lines[-1].startswith("followed to the end, ")


def test_the_tasks_own_sentence_has_the_environments_verdict(
    server: LlmServer, scene: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = vecenv.list_tasks("libero_goal")[8].instruction
    Writer(server)
    failed = invoke("libero_goal/8", own.upper(), *of(server))
    assert failed.exit_code == 1
    assert "verdict: not solved (followed to the end without success)" in failed.stdout
    assert failed.stdout.count("subtasks:") == 3  # three passes
    monkeypatch.setattr(Scene, "solved_after", 1)
    solved = invoke("libero_goal/8", own, *of(server))
    assert solved.exit_code == 0
    assert "verdict: solved, " in solved.stdout


def test_the_goal_of_the_scenes_task_may_end_another_sentence(
    server: LlmServer, scene: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    Writer(server)
    monkeypatch.setattr(Scene, "solved_after", 1)
    done = invoke("libero_goal/8", "raise your hand", *of(server))
    assert done.exit_code == 0
    assert "ended: the goal of the scene's own task was reached" in done.stdout


def test_a_sentence_that_cannot_be_followed_says_why(scene: list[dict[str, Any]]) -> None:
    done = invoke("libero_goal/8", "sing a song")
    assert done.exit_code == 1
    assert "programs by: offline/libero, rule-based" in done.stdout
    assert "not followed: LmpError: planner('sing a song')" in done.stdout


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (failure(500, "oops"), "the language model could not be asked: LlmError: openai/local"),
        (failure(401, "bad key"), "error: openai/local: AuthenticationError: bad key"),
    ],
    ids=["passing", "permanent"],
)
def test_a_model_that_cannot_be_asked_is_status_1(
    server: LlmServer, scene: list[dict[str, Any]], answer: Any, says: str
) -> None:
    Writer(server, {"raise your hand": answer})
    done = invoke("libero_goal/8", "raise your hand", *of(server))
    assert done.exit_code == 1
    assert says in done.output
    assert "Traceback" not in done.output


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["libero_gaol/1", "x"], "unknown suite 'libero_gaol': did you mean libero_goal"),
        (["libero_goal/99", "x"], "libero_goal has tasks 0 to 9"),
        (["libero_goal/1", "x", "--episode", "50"], "episodes 0 to 49"),
        (["libero_goal/1/2", "x"], "the episode as --episode N"),
        (["libero_goal", "x"], "write SUITE/TASK"),
        (["libero_goal/1", "  "], "the sentence is empty"),
        (["libero_goal/1", "x", "--video", "a.gif"], "videos are written as .mp4"),
        (["libero_goal/1", "x", "--policy-arg", "planner.max_stpes=1"], "did you mean planner.max_steps"),
        (["libero_goal/1", "x", "--policy-arg", "passes"], "write key=value"),
        (["libero_goal/1", "x", "--policy-arg", "planner.a=1", "--policy-arg", "planner=2"], "planner is given twice"),
        (["libero_goal/1", "x", "--model", "a", "--policy-arg", "model=b"], "not both"),
    ],
    ids=str,
)
def test_wrong_arguments_are_status_2_and_one_sentence(arguments: list[str], says: str) -> None:
    done = invoke(*arguments)
    assert done.exit_code == 2
    assert says in done.output
    assert done.output.startswith("error: ")
    assert done.output.count("\n") == 1


def test_names_with_dots_are_nested() -> None:
    given = ["planner.max_steps=9", "planner.target_spacing=2", "model=gpt-4o", "perception.tilts=[0.1, 0.2]"]
    assert pairs("--policy-arg", given) == {
        "planner": {"max_steps": 9, "target_spacing": 2},
        "model": "gpt-4o",
        "perception": {"tilts": [0.1, 0.2]},
    }


@needs_gl
@pytest.mark.heavy
def test_a_video_shows_every_control_step(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    path = tmp_path / "run.mp4"
    followed = follow("libero_goal", 8, 0, "lift the bowl", {}, video=path)
    assert followed.ok
    assert followed.ticks > 20
    assert followed.frames == followed.ticks + 1
    with av.open(str(path)) as video:
        assert sum(1 for _ in video.decode(video=0)) == followed.frames
