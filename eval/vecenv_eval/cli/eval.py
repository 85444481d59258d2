"""``vecenv eval``: a policy evaluated on a suite, from the command line.

Options or a YAML file come in; a progress bar, a table with Wilson 95 % intervals and the path of the results folder
come out (``vecenv_eval.cli.screen``), or one JSON object a line with ``--json`` (``vecenv_eval.cli.json_lines``). The
exit status is 0 when every episode has a verdict, 1 when some have none, 2 when the arguments are wrong or the results
folder cannot be read or written, 130 after Ctrl-C and 143 after SIGTERM (what was computed is kept, and the command
that resumes it is printed).
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import typer

from vecenv.cli import fail
from vecenv.errors import MissingDependency, VecenvError
from vecenv.util.logs import reported
from vecenv_eval.cli.options import given_settings, with_settings
from vecenv_eval.cli.signals import INTERRUPTED, TERMINATED, Terminated, stopping
from vecenv_eval.config import ConfigError, EvalConfig, option_name, read_settings, setting

if TYPE_CHECKING:
    from vecenv_eval.campaign import Campaign, CampaignSummary, Leg
    from vecenv_eval.results import EvalResult, Progress
    from vecenv_eval.runner import Evaluation
    from vecenv_eval.store import ResultStore


_log = logging.getLogger(__name__)
# Settings that decide results and are nevertheless given with --resume: `vecenv_eval.results.refuse_untold`.
_GIVEN_AGAIN = ("policy", "policy_args")


class Display(Protocol):
    """Where the command shows what happens."""

    def begin(self, config: EvalConfig, folder: Path, legs: Sequence[Leg], num_episodes: Sequence[int]) -> None:
        """Settings were checked, the runs are about to begin; ``num_episodes`` of each."""
        ...

    def progress(self, leg: Leg, now: Progress) -> None:
        """A run reports."""
        ...

    def result(self, leg: Leg, result: EvalResult) -> None:
        """A run has ended."""
        ...

    def campaign(self, summary: CampaignSummary) -> None:
        """All runs of several have ended."""
        ...

    def failed(self, message: str, status: int) -> None:
        """The command ends with this status because of what the message, if any, says."""
        ...

    def end(self, status: int, folder: Path) -> None:
        """The command ends with this status."""
        ...


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
        None,
        help="Results folder to continue; it keeps its settings. A policy of your own, with its arguments, and an "
        "engine are given again.",
        show_default="none",
    ),
    quiet: bool = typer.Option(False, "--quiet", help="Print the path of the results folder and nothing else."),
    as_json: bool = typer.Option(
        False, "--json", help="Print one JSON object a line, as the evaluation goes on, and nothing else."
    ),
    **settings: Any,
) -> None:
    """Evaluate a policy on a suite: success rates with Wilson 95 % intervals."""
    if quiet and as_json:
        fail("give --quiet or --json, not both")
    sys.path.append(str(Path.cwd()))  # so that --policy module:Class finds a module beside the user
    reports = nullcontext() if quiet else reported()  # of what is compiled, which takes minutes on a GPU
    with _display(quiet, as_json) as display, reports, _user_errors(display), stopping() as stop:
        status, folder = _evaluate(display, given_settings(settings), config, out, resume)
        status = stop.status if status == INTERRUPTED else status
        display.end(status, folder)
    raise typer.Exit(status)


def _evaluate(
    display: Display, given: dict[str, Any], config: Path | None, out: Path | None, resume: Path | None
) -> tuple[int, Path]:
    """Run what the options ask for; returns the exit status and the results folder."""
    from vecenv_eval.campaign import CAMPAIGN, Campaign, is_campaign

    if resume is not None and (resume / CAMPAIGN).exists():
        _refuse_settings(resume, given, config, out)
        with _stopped(resume):
            return _run_campaign(display, Campaign.open(resume, **given))
    if resume is not None:
        with _stopped(resume):
            with _disk_errors(resume):
                evaluation, store = _resume(resume, given, config, out)
            return _run(display, evaluation, store)
    wanted = _wanted(given, config)
    folder = out or _default_folder(wanted)
    with _stopped(folder):
        if is_campaign(wanted):
            return _run_campaign(display, Campaign(wanted, folder))
        return _run_new(display, wanted, folder)


@contextmanager
def _display(quiet: bool, as_json: bool) -> Iterator[Display]:
    """What shows the evaluation; where the output has a form, what others print goes to standard error."""
    from vecenv_eval.cli.json_lines import JsonLines, own_stdout
    from vecenv_eval.cli.screen import Screen

    if not (quiet or as_json):
        with closing(Screen()) as screen:
            yield screen
        return
    with own_stdout() as stream:
        yield JsonLines(stream) if as_json else Screen(stream, quiet=True)


def _wanted(given: dict[str, Any], file: Path | None) -> EvalConfig:
    """The config of options and file."""
    given = {**(read_settings(file) if file else {}), **given}
    if not given.get("suite"):
        raise ConfigError("--suite is needed; `vecenv list` names the suites (or --resume continues a results folder)")
    return EvalConfig.from_dict(given)


def _default_folder(config: EvalConfig) -> Path:
    from vecenv_eval.store import RESULTS, default_folder

    return default_folder(RESULTS, "+".join(config.suites), config.policy_name)


def _run_new(display: Display, config: EvalConfig, folder: Path) -> tuple[int, Path]:
    """A new evaluation, or the same one continued; no folder is made before the settings were checked."""
    from vecenv_eval.results import CAMPAIGN, open_or_begin
    from vecenv_eval.runner import Evaluation

    with _disk_errors(folder):
        several = (folder / CAMPAIGN).is_file()
    if several:
        raise ConfigError(f"{folder} is already there and holds several suites or seeds: name another folder")
    evaluation = Evaluation(config)
    with _disk_errors(folder):
        store = open_or_begin(config, folder)
    return _run(display, evaluation, store)


def _resume(folder: Path, given: dict[str, Any], file: Path | None, out: Path | None) -> tuple[Evaluation, ResultStore]:
    """An evaluation that is continued; what decides its results is in the folder and cannot be given again."""
    from vecenv_eval.results import resume
    from vecenv_eval.runner import Evaluation

    _refuse_settings(folder, given, file, out)
    config, store = resume(folder, **given)
    return Evaluation(config), store


def _refuse_settings(folder: Path, given: dict[str, Any], file: Path | None, out: Path | None) -> None:
    """Refuse settings that the folder holds already, but those that may have to be given again."""
    refused = [
        *(
            option_name(each)
            for each in fields(EvalConfig)
            if each.name in given and each.name not in _GIVEN_AGAIN and not setting(each).resumable
        ),
        *(name for name, value in (("--config", file), ("--out", out)) if value),
    ]
    if refused:
        raise ConfigError(f"--resume keeps the settings of {folder}: leave out {', '.join(refused)}")


def _run_campaign(display: Display, campaign: Campaign) -> tuple[int, Path]:
    """Run several suites or seeds."""
    display.begin(campaign.config, campaign.folder, campaign.legs, campaign.num_episodes)
    with _disk_errors(campaign.folder):
        summary, results = campaign.run(
            display.progress, display.result, lambda leg, store: _say_how_rows_are_kept(store)
        )
    display.campaign(summary)
    if any(result.interrupted for result in results):
        return INTERRUPTED, campaign.folder
    complete = len(results) == len(campaign.legs) and all(result.ok for result in results)
    return (0 if complete else 1), campaign.folder


def _run(display: Display, evaluation: Evaluation, store: ResultStore) -> tuple[int, Path]:
    """Run one suite with one seed."""
    from vecenv_eval.campaign import Leg

    config = evaluation.config
    leg = Leg(suite=config.suite, seed=config.seed, config=config, folder=store.folder)
    display.begin(config, store.folder, [leg], [len(evaluation.planned)])
    _say_how_rows_are_kept(store)
    with _disk_errors(store.folder):
        result = evaluation.run(store, lambda now: display.progress(leg, now))
    display.result(leg, result)
    return (INTERRUPTED if result.interrupted else 0 if result.ok else 1), result.folder


def _say_how_rows_are_kept(store: ResultStore) -> None:
    if notice := store.rows.notice():
        _log.warning(notice)


class _RunError(VecenvError, RuntimeError):
    """A run that cannot go on; the message says why, and how to continue it.

    Attributes:
        status: the command's exit status.
    """

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


@contextmanager
def _stopped(folder: Path) -> Iterator[None]:
    """Ctrl-C or SIGTERM outside the episodes, while something is set up: one line that says how to go on."""
    from vecenv_eval.results import CAMPAIGN, resume_command
    from vecenv_eval.store import CONFIG

    try:
        yield
    except KeyboardInterrupt as stop:
        by, status = (str(stop), TERMINATED) if isinstance(stop, Terminated) else ("Ctrl-C", INTERRUPTED)
        if any((folder / name).is_file() for name in (CONFIG, CAMPAIGN)):
            how = f"what was computed is kept; to go on: {resume_command(folder)}"
        else:
            how = "nothing was computed yet; to begin again, repeat the command"
        raise _RunError(f"stopped by {by} before the first episode or between two: {how}", status) from stop


@contextmanager
def _disk_errors(folder: Path) -> Iterator[None]:
    """Results that cannot be written, or read: whatever else raises such an error has been dealt with below."""
    from vecenv_eval.results import CAMPAIGN, resume_command
    from vecenv_eval.store import CONFIG, StoreWriteError

    try:
        yield
    except (OSError, StoreWriteError) as error:
        there = any(os.path.isfile(folder / name) for name in (CONFIG, CAMPAIGN))  # noqa: PTH113  (raises nothing)
        again = f" What was computed is kept; to go on: {resume_command(folder)}" if there else ""
        what = (
            f"the results in {folder} cannot be written: {error.strerror or error}{_which(error, folder)}"
            if isinstance(error, OSError)
            else error
        )
        raise _RunError(f"{what}.{again}", 2) from error


def _which(error: OSError, folder: Path) -> str:
    """The file that an error is about, if it is in the folder."""
    name = error.filename if isinstance(error.filename, str) else ""
    return f" ({Path(name).relative_to(folder)})" if name and Path(name).is_relative_to(folder / "") else ""


@contextmanager
def _user_errors(display: Display) -> Iterator[None]:
    """A mistake of the user, or a cluster that cannot be used, becomes one line and exit status 2, as does a run that
    cannot go on."""
    from vecenv_eval.engine import EngineError
    from vecenv_eval.episodes import SpecError
    from vecenv_eval.policies import PolicyError
    from vecenv_eval.store import StoreError

    try:
        yield
    except (ConfigError, EngineError, PolicyError, SpecError, StoreError, MissingDependency, _RunError) as error:
        message, status = " ".join(str(error).split()), error.status if isinstance(error, _RunError) else 2
        display.failed(message, status)
        fail(message, status)
    except typer.Exit as exit:  # said already
        display.failed("", exit.exit_code)
        raise
