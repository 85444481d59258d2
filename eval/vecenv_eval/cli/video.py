"""``vecenv video``: many episodes side by side in one video, each framed by its verdict.

Either a policy runs: the settings of ``vecenv eval`` that say what runs come in, as options or from a YAML file. Or
results folders come in, whose episodes were filmed before. Out: the file and a line that says how many episodes were
solved. The exit status is 2 when the arguments are wrong or a folder cannot be used, and 1 when images cannot be
rendered or written, or the policy cannot go on.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from vecenv.cli import fail
from vecenv.util.names import unknown
from vecenv_eval.cli.options import some_settings, user_errors, with_settings
from vecenv_eval.config import ConfigError, EvalConfig, option_name

if TYPE_CHECKING:
    from vecenv_eval.video.film import Film

# Step budget of LIBERO's videos, control ticks.
_MAX_STEPS = 400
SETTINGS = (
    *("suite", "policy", "tasks", "episodes", "policy_args", "protocol", "backend", "max_steps", "seed"),
    *("image_size", "lod", "colors", "cameras", "env_args", "num_threads"),
)
_ALSO = {"tasks": "--task", "image_size": "--size", "cameras": "--camera"}
# One task's first episode, unless others are asked for.
_USUAL = {"tasks": "0", "episodes": "1"}
_OF_ALL = "of --results: all"
_SHOWN = {
    "suite": f"required; {_OF_ALL}",
    **{name: f"{value}; {_OF_ALL}" for name, value in _USUAL.items()},
    "image_size": "256; of --results: as filmed",
    "max_steps": f"{_MAX_STEPS} in LIBERO without --protocol; else the protocol's",
    "cameras": "agentview",
}
_HELPS = {
    "suite": "Suite; `vecenv list` names them.",
    "cameras": "Cameras that the video shows, side by side; repeatable, or a,b.",
}


# Settings that choose among filmed episodes, or say how large they are shown.
_OF_RESULTS = ("suite", "tasks", "episodes", "image_size")


@partial(with_settings, names=SETTINGS, also=_ALSO, shown=_SHOWN, helps=_HELPS)
def video_command(
    results: list[Path] | None = typer.Option(
        None,
        help="Results folder whose filmed episodes are shown, in place of running a policy; repeatable. --suite, "
        "--tasks and --episodes choose some, --image-size scales.",
        show_default="none",
    ),
    every: int = typer.Option(1, min=1, help="Show every so many control ticks."),
    fps: float | None = typer.Option(None, help="Frames a second.", show_default="as fast as the robot moves"),
    hold: float = typer.Option(0.0, min=0.0, help="Seconds that the last frame stays."),
    columns: int | None = typer.Option(None, min=1, help="Episodes in a row.", show_default="as many as rows"),
    titles: bool = typer.Option(True, help="Write episode and instruction above each image."),
    border: int | None = typer.Option(
        None, min=0, help="Width of the frame in the colour of the verdict, pixels.", show_default="2"
    ),
    config: Path | None = typer.Option(
        None, help="YAML file of settings, by the names of EvalConfig's fields; options override it."
    ),
    out: Path = typer.Option(Path("video.mp4"), help="The file to write: .mp4, or .webp for an animated image."),
    **settings: Any,
) -> None:
    """Show episodes side by side in one video, titled, framed by verdict: of a policy that runs, or of results."""
    sys.path.append(str(Path.cwd()))  # so that --policy module:Class finds a module beside the user
    with user_errors():
        given = some_settings(settings, config, SETTINGS, "video")
        from vecenv_eval.video.film import Film
        from vecenv_eval.video.writer import check_suffix

        check_suffix(out, "--out")
        _check_place(out)
        film = Film(every=every, fps=fps, columns=columns, titles=titles, hold=hold)
        if border is not None:
            film = replace(film, border=border)
        if results:
            _show(results, given, out, film)
        else:
            _run({**_USUAL, **given}, out, film)


def _check_place(out: Path) -> None:
    """Refuse a file that cannot be made, before anything runs."""
    folder = next(each for each in out.absolute().parents if each.exists())
    if out.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        why = "it is a folder" if out.is_dir() else f"no file can be made in {folder}"
        fail(f"--out {out} cannot be written: {why}")


def _run(given: Mapping[str, Any], out: Path, film: Film) -> None:
    """Run a policy and record it."""
    if not given.get("suite"):
        fail("--suite or --results is needed; `vecenv list` names the suites")
    from vecenv_eval.rollout import record_config

    frames, solved, count = record_config(_with_budget(EvalConfig.from_dict(given), "protocol" in given), out, film)
    typer.echo(f"{out}: {frames} frames, {solved} of {count} episodes solved")


def _show(results: Sequence[Path], given: Mapping[str, Any], out: Path, film: Film) -> None:
    """Show episodes that were filmed before."""
    names = {each.name: option_name(each) for each in fields(EvalConfig)}
    for name in given:
        if name not in _OF_RESULTS:
            fail(f"{names[name]}: the episodes of --results have been run and filmed already")
    from vecenv_eval.store import StoreError
    from vecenv_eval.wall import write_wall

    config = EvalConfig.from_dict({"suite": "", **given})
    try:
        wall = write_wall(
            results,
            out,
            film=film,
            suites=_known(config.suites) if config.suite else (),
            tasks=given.get("tasks"),
            episodes=given.get("episodes"),
            height=given.get("image_size"),
        )
    except StoreError as error:
        fail(" ".join(str(error).split()))
    except OSError as error:
        fail(f"--out {out} cannot be written: {error.strerror or error}")
    without = f"; {wall.without} more have no video" if wall.without else ""
    typer.echo(f"{out}: {wall.frames} frames, {wall.solved} of {wall.episodes} episodes solved{without}")


def _known(suites: Sequence[str]) -> Sequence[str]:
    """The suites, if they all exist."""
    import vecenv

    for suite in suites:
        if suite not in vecenv.list_suites():
            fail(unknown("suite", suite, vecenv.list_suites()))
    return suites


def _with_budget(config: EvalConfig, protocol_given: bool) -> EvalConfig:
    """The config with the step budget of a video, where neither it nor a protocol says another."""
    import vecenv

    if len(config.suites) != 1:
        raise ConfigError(f"--suite {config.suite}: a video shows one suite")
    if config.max_steps is None and not protocol_given and vecenv.family(config.suite) == "libero":
        return replace(config, max_steps=_MAX_STEPS)
    return config
