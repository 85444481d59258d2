"""``vecenv voxposer``: the commands of ``voxposer.cli``, and ``run``, which needs the harness's policies and videos.

``run`` plans a sentence in the scene of a task and follows it. The exit status is 0 when the task's own sentence was
solved, or another was followed to its end; 1 when it was not, or the language model could not be asked; 2 when the
arguments are wrong.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from vecenv.cli import fail
from vecenv_eval.cli.options import pairs, user_errors
from voxposer.cli import voxposer_app

if TYPE_CHECKING:
    from vecenv_eval.sentence import Followed, Round

__all__ = ["voxposer_app"]


@voxposer_app.command("run")
def run_command(
    task: str = typer.Argument(..., help="SUITE/TASK, such as libero_goal/0: the scene."),
    sentence: str = typer.Argument(..., help="What to do there, in quotes."),
    episode: int = typer.Option(0, min=0, help="Episode of the task: where things stand."),
    model: str | None = typer.Option(
        None,
        help="litellm's name of the language model that writes the programs.",
        show_default="offline/libero, a rule base and no language model",
    ),
    video: Path | None = typer.Option(None, help="Write an mp4 of it.", show_default="none"),
    policy_arg: list[str] = typer.Option([], help="key=value for the policy, as of `vecenv eval`; repeatable."),
) -> None:
    """Plan a sentence of your own in a task's scene, and follow it."""
    with user_errors():
        options = pairs("--policy-arg", policy_arg)
        if model is not None:
            if "model" in options:
                fail("give --model or --policy-arg model=..., not both")
            options["model"] = model
        if not sentence.strip():
            fail("the sentence is empty")
        if video is not None and video.suffix != ".mp4":
            fail(f"--video {video}: videos are written as .mp4")
        followed = _followed(task, episode, sentence, options, video)
    _print_end(followed, video)
    raise typer.Exit(0 if followed.ok else 1)


def _followed(task: str, episode: int, sentence: str, options: dict[str, Any], video: Path | None) -> Followed:
    from vecenv_eval.sentence import follow, parse_scene

    suite, number = parse_scene(task, episode)
    return follow(suite, number, episode, sentence, options, video=video, on_round=_Rounds())


class _Rounds:
    """Prints the subtasks of each pass before its first round, and each round."""

    def __init__(self) -> None:
        self._printed: tuple[str, ...] = ()
        self._before = 0

    def __call__(self, subtasks: tuple[str, ...], done: Round) -> None:
        if subtasks and (subtasks != self._printed or done.number - self._before > len(subtasks)):
            self._printed, self._before = subtasks, done.number - 1
            typer.echo("subtasks:")
            for number, text in enumerate(subtasks, start=1):
                typer.echo(f"  {number}. {text}")
            typer.echo("done:")
        if done.waypoints:
            missed = f", {done.missed} missed" if done.missed else ""
            typer.echo(f"  {done.subtask}: {done.waypoints} waypoints{missed}, {done.ticks} ticks")


def _print_end(followed: Followed, video: Path | None) -> None:
    """How it ended: cause, and the verdict where there is one."""
    from voxposer.slots import FOLLOWED

    typer.echo(f"programs by: {followed.writer}")
    if followed.error:
        typer.echo(f"the language model could not be asked: {followed.error}")
    elif followed.own:
        verdict = "solved" if followed.success else f"not solved ({followed.cause})"
        typer.echo(f"verdict: {verdict}, {followed.ticks} ticks")
    elif followed.success:
        typer.echo(f"ended: the goal of the scene's own task was reached, {followed.ticks} ticks")
    elif followed.cause == FOLLOWED:
        typer.echo(f"followed to the end, {followed.ticks} ticks; only the task's own sentence has a verdict")
    else:
        typer.echo(f"not followed: {followed.cause}, {followed.ticks} ticks")
    if video is not None:
        typer.echo(f"{video}: {followed.frames} frames")
