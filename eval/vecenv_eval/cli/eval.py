"""``vecenv eval``: a policy evaluated on a suite, from the command line.

Options or a YAML file come in; a progress bar, a table with Wilson 95 % intervals and the path of the results folder
come out. The exit status is 0 when every episode has a verdict, 1 when some have none, 2 when the arguments are wrong
and 130 after Ctrl-C (what was computed is kept, and the command that resumes it is printed).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from vecenv.cli import fail
from vecenv_eval.cli.options import given_settings, with_settings
from vecenv_eval.config import ConfigError, EvalConfig, option_name, read_settings, setting

if TYPE_CHECKING:
    from rich.console import Console

    from vecenv_eval.campaign import Campaign, Leg
    from vecenv_eval.results import EvalResult, Progress
    from vecenv_eval.runner import Evaluation
    from vecenv_eval.store import ResultStore

# Without a terminal, a line is printed each time this share of the episodes has ended.
_SHARE = 0.1


@with_settings
def eval_command(
    config: Path | None = typer.Option(
        None, help="YAML file of settings, by the names of EvalConfig's fields; options override it."
    ),
    out: Path | None = typer.Option(
        None,
        help="Results folder to make; the same settings continue one that is there.",
        show_default="results/TIME_SUITE_POLICY",
    ),
    resume: Path | None = typer.Option(
        None, help="Results folder to continue; it keeps its settings.", show_default="none"
    ),
    quiet: bool = typer.Option(False, "--quiet", help="Print the path of the results folder and nothing else."),
    **settings: Any,
) -> None:
    """Evaluate a policy on a suite: success rates with Wilson 95 % intervals."""
    from vecenv_eval.campaign import CAMPAIGN, Campaign, is_campaign

    given = given_settings(settings)
    sys.path.append(str(Path.cwd()))  # so that --policy module:Class finds a module beside the user
    with _user_errors():
        if resume is not None and (resume / CAMPAIGN).exists():
            _refuse_settings(resume, given, config, out)
            status = _run_campaign(Campaign.open(resume), quiet)
        elif resume is not None:
            status = _run(*_resume(resume, given, config, out), quiet)
        else:
            wanted = _wanted(given, config)
            folder = out or _default_folder(wanted)
            status = (
                _run_campaign(Campaign(wanted, folder), quiet)
                if is_campaign(wanted)
                else _run_new(wanted, folder, quiet)
            )
    raise typer.Exit(status)


def _wanted(given: dict[str, Any], file: Path | None) -> EvalConfig:
    """The config of options and file."""
    given = {**(read_settings(file) if file else {}), **given}
    if not given.get("suite"):
        fail("--suite is needed; `vecenv list` names the suites (or --resume continues a results folder)")
    return EvalConfig.from_dict(given)


def _default_folder(config: EvalConfig) -> Path:
    from vecenv_eval.store import RESULTS, default_folder

    return default_folder(RESULTS, "+".join(config.suites), config.policy_name)


def _run_new(config: EvalConfig, folder: Path, quiet: bool) -> int:
    """A new evaluation, or the same one continued; no folder is made before the settings were checked."""
    from vecenv_eval.campaign import CAMPAIGN
    from vecenv_eval.results import open_or_begin
    from vecenv_eval.runner import Evaluation

    if (folder / CAMPAIGN).is_file():
        fail(f"{folder} is already there and holds several suites or seeds: name another folder")
    evaluation = Evaluation(config)
    return _run(evaluation, open_or_begin(config, folder), quiet)


def _resume(folder: Path, given: dict[str, Any], file: Path | None, out: Path | None) -> tuple[Evaluation, ResultStore]:
    """An evaluation that is continued; what decides its results is in the folder and cannot be given again."""
    from vecenv_eval.results import resume
    from vecenv_eval.runner import Evaluation

    _refuse_settings(folder, given, file, out, but_resumable=True)
    config, store = resume(folder, **given)
    return Evaluation(config), store


def _refuse_settings(
    folder: Path, given: dict[str, Any], file: Path | None, out: Path | None, but_resumable: bool = False
) -> None:
    """Refuse settings that the folder holds already."""
    refused = [
        *(
            option_name(each)
            for each in fields(EvalConfig)
            if each.name in given and not (but_resumable and setting(each).resumable)
        ),
        *(name for name, value in (("--config", file), ("--out", out)) if value),
    ]
    if refused:
        fail(f"--resume keeps the settings of {folder}: leave out {', '.join(refused)}")


def _run_campaign(campaign: Campaign, quiet: bool) -> int:
    """Run several suites or seeds and print; returns the exit status."""
    from rich.console import Console
    from rich.markdown import Markdown

    from vecenv_eval.campaign import markdown

    console = Console(quiet=quiet)
    with _progress(console) as on_progress:

        def report(leg: Leg, progress: Progress) -> None:
            on_progress(progress)

        def begun(leg: Leg, store: ResultStore) -> None:
            if leg is campaign.legs[0] and (notice := store.rows.notice()):
                console.print(notice, style="yellow", markup=False, highlight=False, soft_wrap=True)

        def finished(leg: Leg, result: EvalResult) -> None:
            seed = "" if leg.seed is None else f", seed {leg.seed}"
            console.print(f"[bold]{leg.suite}[/bold]{seed}")
            print_result(console, result)

        summary, results = campaign.run(report, finished, begun)
    console.print(Markdown(markdown(summary)))
    typer.echo(campaign.folder)
    if any(result.interrupted for result in results):
        return 130
    return 0 if len(results) == len(campaign.legs) and all(result.ok for result in results) else 1


@contextmanager
def _user_errors() -> Iterator[None]:
    """A mistake of the user becomes one line and exit status 2, and so does a cluster that cannot be used."""
    from vecenv_eval.engine import EngineError
    from vecenv_eval.episodes import SpecError
    from vecenv_eval.policies import PolicyError
    from vecenv_eval.store import StoreError

    try:
        yield
    except (ConfigError, EngineError, PolicyError, SpecError, StoreError) as error:
        fail(" ".join(str(error).split()))


def _run(evaluation: Evaluation, store: ResultStore, quiet: bool) -> int:
    """Run and print; returns the exit status."""
    from rich.console import Console

    console = Console(quiet=quiet)
    if notice := store.rows.notice():
        console.print(notice, style="yellow", markup=False, highlight=False, soft_wrap=True)
    with _user_errors(), _progress(console) as on_progress:
        result = evaluation.run(store, on_progress)
    print_result(console, result)
    typer.echo(result.folder)
    return 130 if result.interrupted else 0 if result.ok else 1


def print_result(console: Console, result: EvalResult) -> None:
    """Print how an evaluation ended: its table, what is wrong, and how to go on."""
    from vecenv_eval.report import STAND_INS, closing_line, stand_in_lines, table

    console.print(table(result.summary))
    console.print(closing_line(result.summary), highlight=False, soft_wrap=True)
    if result.summary.stand_ins:
        console.print(f"{STAND_INS}:", style="yellow")
    for line in stand_in_lines(result.summary):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    for cause in result.causes:
        console.print(f"error that ended episodes: {cause}", style="red", markup=False, highlight=False, soft_wrap=True)
    if not result.ok:
        again = f"Episodes lack a verdict; to run them: vecenv eval --resume {result.folder}"
        console.print(again, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[Progress], None]]:
    """A progress bar on a terminal, a line from time to time elsewhere."""
    if not console.is_terminal or console.quiet:
        yield _Lines(console)
        return
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as RichProgress

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with RichProgress(*columns, console=console) as bar:
        task = bar.add_task("starting", total=None)
        yield lambda now: bar.update(task, description=_describe(now), total=now.total, completed=now.done + now.errors)


class _Lines:
    """Progress for logs: a line per batch and per tenth of the episodes."""

    def __init__(self, console: Console) -> None:
        self._console, self._next = console, _SHARE

    def __call__(self, now: Progress) -> None:
        ended = now.done + now.errors
        if now.setting_up or ended >= self._next * now.total:
            self._console.print(f"{ended}/{now.total} episodes, {_describe(now)}", highlight=False)
            self._next = ended / now.total + _SHARE


def _describe(now: Progress) -> str:
    batch = f"batch {now.batch + 1}/{now.num_batches}"
    if now.setting_up:
        return f"{batch}: setting up"
    problems = "".join(f", {n} {what}" for n, what in ((now.faults, "faulted"), (now.errors, "failed")) if n)
    speed = now.steps / now.seconds if now.seconds else 0.0
    return f"{batch}: {now.successes} solved{problems}, {speed:,.0f} steps/s"
