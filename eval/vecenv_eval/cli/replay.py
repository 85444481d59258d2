"""``vecenv replay``: recorded actions executed again, and their verdicts compared with those on record.

Files come in and a table goes out. The exit status is 0 when every verdict agrees, 1 when one does not or a
demonstration cannot be replayed, and 2 when the arguments are wrong.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from vecenv.cli import fail
from vecenv.util.names import unknown

if TYPE_CHECKING:
    from rich.console import Console

    from vecenv_eval.demos.outcomes import ReplayReport


def replay_command(
    files: list[Path] = typer.Argument(
        ..., help="Demonstrations in LIBERO's HDF5 layout, or folders of them, such as a results folder."
    ),
    suite: str | None = typer.Option(None, help="What the files demonstrate.", show_default="what they say"),
    task: int | None = typer.Option(None, min=0, help="Task of --suite.", show_default="what they say"),
    backend: str | None = typer.Option(None, help="Physics backend.", show_default="the one on record"),
    contacts: str | None = typer.Option(None, help="published or current.", show_default="those on record"),
    num_envs: int = typer.Option(256, min=1, help="Most demonstrations that run at once."),
    num_threads: int | None = typer.Option(None, min=1, help="Threads of the physics.", show_default="the backend's"),
    out: Path | None = typer.Option(None, help="JSON file to write the outcomes to.", show_default="none"),
) -> None:
    """Execute recorded actions again and compare the verdicts."""
    from rich.console import Console

    from vecenv.libero.scene.contacts import CONTACTS
    from vecenv_eval.demos.files import ReplayError, find_files, read_files
    from vecenv_eval.demos.replay import ReplayConfig, replay

    _check_task(suite, task)
    if contacts is not None and contacts not in CONTACTS:
        fail(unknown("contacts", contacts, CONTACTS))
    if out and not out.absolute().parent.is_dir():
        fail(f"--out {out}: there is no folder {out.absolute().parent}")
    try:
        demos, unreadable = read_files(find_files(files), suite=suite, task=task)
    except ReplayError as error:
        fail(str(error))
    console = Console()
    config = ReplayConfig(backend=backend, contacts=contacts, num_envs=num_envs, num_threads=num_threads)
    report = replay(demos, config, on_batch=lambda text: console.print(text, highlight=False))
    report = dataclasses.replace(report, problems=(*unreadable, *report.problems))
    _print_replay(console, report)
    if out:
        out.write_text(json.dumps(report.to_dict(), indent=2) + "\n")
    raise typer.Exit(0 if report.ok else 1)


def _check_task(suite: str | None, task: int | None) -> None:
    import vecenv

    if suite is None:
        if task is not None:
            fail("--task needs --suite")
        return
    if suite not in vecenv.list_suites("libero"):
        fail(unknown("suite", suite, vecenv.list_suites("libero")))
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
