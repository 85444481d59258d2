"""``vecenv replay``: recorded actions executed again, and their verdicts compared with those on record.

Files come in and a table goes out; with ``--video`` or ``--record-lerobot`` also a folder of images of what was
executed. Options of ``vecenv eval`` choose among the demonstrations or hold in place of what is on record. The exit
status is 0 when every verdict agrees, 1 when one does not or a demonstration cannot be replayed, and 2 when the
arguments are wrong.
"""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from vecenv.cli import fail
from vecenv.util.names import unknown
from vecenv_eval.cli.options import some_settings, user_errors, with_settings
from vecenv_eval.config import ConfigError, EvalConfig, option_name

if TYPE_CHECKING:
    from rich.console import Console

    from vecenv_eval.demos.outcomes import ReplayReport
    from vecenv_eval.demos.schema import Demo
    from vecenv_eval.watch import EpisodeRecorder

_IMAGES = ("image_size", "lod", "colors", "cameras")
SETTINGS = ("suite", "tasks", "episodes", "backend", *_IMAGES, "env_args", "num_envs", "num_threads", "video")
SETTINGS += ("record_lerobot",)
_MOST = 256
_ON_RECORD, _THEIR_OWN = "as on record", "what they say"
_SHOWN = {
    "suite": _THEIR_OWN,
    **dict.fromkeys(("tasks", "episodes"), "all"),
    **dict.fromkeys(("backend", "env_args"), _ON_RECORD),
    "num_envs": str(_MOST),
    "image_size": "256",
    "cameras": "agentview,wrist",
}
_HELPS = {
    "suite": "What the files demonstrate.",
    "tasks": "Replay those of these tasks: indices, ranges, names and patterns: 0,3,5-7 or pick*.",
    "episodes": "Replay those of these episodes: a count, or indices and ranges: 0,3,5-7.",
    "num_envs": "Most demonstrations that run at once.",
    "env_args": "key=value for vecenv.make; repeatable.",
    "cameras": "Cameras of videos and LeRobot data; repeatable, or a,b.",
    "video": "Write one mp4 a demonstration into RESULTS/videos: failures, all or none.",
    "record_lerobot": "Write what is executed as a LeRobot dataset into RESULTS/lerobot.",
}


@partial(with_settings, names=SETTINGS, shown=_SHOWN, helps=_HELPS)
def replay_command(
    files: list[Path] = typer.Argument(
        ..., help="Demonstrations in LIBERO's HDF5 layout, or folders of them, such as a results folder."
    ),
    task: int | None = typer.Option(
        None, min=0, help="Task of --suite that the files demonstrate.", show_default=_THEIR_OWN
    ),
    contacts: str | None = typer.Option(None, help="published or current (LIBERO).", show_default=_ON_RECORD),
    config: Path | None = typer.Option(
        None, help="YAML file of settings, by the names of EvalConfig's fields; options override it."
    ),
    results: Path | None = typer.Option(None, help="New folder for videos and LeRobot data.", show_default="none"),
    out: Path | None = typer.Option(None, help="JSON file to write the outcomes to.", show_default="none"),
    **settings: Any,
) -> None:
    """Execute recorded actions again and compare the verdicts."""
    with user_errors():
        given = some_settings(settings, config, SETTINGS, "replay")
        _check_arguments(given, task, contacts, results, out)
        report = _replay(files, given, task, contacts, results)
    if out:
        out.write_text(json.dumps(report.to_dict(), indent=2) + "\n")
    raise typer.Exit(0 if report.ok else 1)


def _replay(
    files: Sequence[Path], given: Mapping[str, Any], task: int | None, contacts: str | None, results: Path | None
) -> ReplayReport:
    """Replay and print."""
    from rich.console import Console

    from vecenv_eval.demos.files import choose, find_files, read_files
    from vecenv_eval.demos.replay import ReplayConfig, replay

    config = EvalConfig.from_dict({"suite": "", **given})
    demos, unreadable = read_files(find_files(files), suite=config.suite or None, task=task)
    demos = choose(demos, given.get("tasks"), given.get("episodes"))
    how = ReplayConfig(
        backend=given.get("backend"),
        contacts=contacts,
        options=_options(config, demos),
        num_envs=config.num_envs or _MOST,
        num_threads=config.num_threads,
    )
    for suite in dict.fromkeys(demo.suite for demo in demos):
        how.check_suite(suite)
    console = Console()
    recorders = [] if results is None else _recorders(config, demos, results)
    try:
        report = replay(demos, how, on_batch=lambda text: console.print(text, highlight=False), recorders=recorders)
    finally:
        for recorder in recorders:
            recorder.close()
    report = dataclasses.replace(report, problems=(*unreadable, *report.problems))
    _print_replay(console, report)
    return report


def _options(config: EvalConfig, demos: Sequence[Demo]) -> dict[str, Any]:
    """Options of ``vecenv.make`` in place of those on record: what an evaluation makes of the same settings.

    Raises:
        ConfigError: a suite does not have such images, or a scene does not have a camera.
    """
    from vecenv_eval.environments import image_arguments
    from vecenv_eval.runner import check_cameras
    from vecenv_eval.simulator import describe_suite

    options = dict(config.env_args)
    for suite in dict.fromkeys(demo.suite for demo in demos):
        own = dataclasses.replace(config, suite=suite)
        check_cameras(own, describe_suite(suite), {demo.task for demo in demos if demo.suite == suite})
        options |= image_arguments(own)
    return options


def _recorders(config: EvalConfig, demos: Sequence[Demo], results: Path) -> list[EpisodeRecorder]:
    """The recorders that were asked for.

    Raises:
        ConfigError: the folder is in use, or two demonstrations would be written to one place.
    """
    from vecenv_eval.recorders import image_recorders

    if results.exists() and (not results.is_dir() or any(results.iterdir())):
        raise ConfigError(f"--results {results}: it is already there and not empty")
    counts = Counter(demo.key for demo in demos)
    twice = next((key for key, count in counts.items() if count > 1), None)
    if twice is not None:
        raise ConfigError(f"--results {results}: two demonstrations are of episode {twice.id}; name one of the files")
    return image_recorders(config, results)


def _check_arguments(
    given: Mapping[str, Any], task: int | None, contacts: str | None, results: Path | None, out: Path | None
) -> None:
    from vecenv.libero.scene.contacts import CONTACTS

    _check_task(given.get("suite"), task)
    if contacts is not None and contacts not in CONTACTS:
        fail(unknown("contacts", contacts, CONTACTS))
    if out and not out.absolute().parent.is_dir():
        fail(f"--out {out}: there is no folder {out.absolute().parent}")
    names = {each.name: option_name(each) for each in dataclasses.fields(EvalConfig)}
    writers = [name for name in ("video", "record_lerobot") if given.get(name) not in (None, "none", False)]
    if writers and results is None:
        fail(f"{names[writers[0]]} needs --results, the folder to write into")
    if results is not None and not writers:
        fail(f"--results {results}: give --video or --record-lerobot, which write there")
    for name in _IMAGES:
        if name in given and not writers:
            fail(f"{names[name]}: images are drawn for --video and --record-lerobot only")


def _check_task(suite: str | None, task: int | None) -> None:
    import vecenv

    if suite is None:
        if task is not None:
            fail("--task needs --suite")
        return
    if suite not in vecenv.list_suites():
        fail(unknown("suite", suite, vecenv.list_suites()))
    count = len(vecenv.list_tasks(suite))
    if task is not None and task >= count:
        fail(f"--task {task}: {suite} has tasks 0 to {count - 1}")


def _print_replay(console: Console, report: ReplayReport) -> None:
    from vecenv_eval.demos.outcomes import closing_line, table

    if report.outcomes:
        console.print(table(report))
    for problem in report.problems:
        console.print(f"error: {problem}", style="red", markup=False, highlight=False, soft_wrap=True)
    console.print(closing_line(report), highlight=False, soft_wrap=True)
