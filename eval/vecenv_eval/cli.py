"""``vecenv eval`` and ``vecenv replay``: the harness on the command line.

For ``eval``, flags come in; a progress bar, a table with Wilson 95 % intervals and the path of the results folder come
out. The exit status is 0 when every episode has a verdict, 1 when some have none, 2 when the arguments make no sense
and 130 after Ctrl-C (what was computed is kept, and the command that goes on with it is printed). For ``replay``, files
come in and a table goes out; the exit status is 0 when every verdict agrees, 1 when one does not or a demonstration
cannot be replayed, and 2 when the arguments make no sense.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from vecenv.cli import fail, unknown

if TYPE_CHECKING:
    from rich.console import Console

    from vecenv_eval.demos.replay import ReplayReport
    from vecenv_eval.runner import EvalResult, Evaluation, Progress
    from vecenv_eval.store import ResultStore

RESULTS = Path("results")
# Without a terminal, a line is printed each time this share of the episodes is through.
_SHARE = 0.1
_FLAGS = {"policy_args": "--policy-arg", "env_args": "--env-arg"}


def eval_command(
    suite: str | None = typer.Option(
        None, help="Suite to evaluate; `vecenv list` names them.", show_default="required"
    ),
    policy: str | None = typer.Option(
        None,
        help="random, zero, voxposer, pick_place (LIBERO), simpler_scripted, or your own module:Class.",
        show_default="the suite's scripted one",
    ),
    tasks: str | None = typer.Option(None, help="all, or indices, ranges and names: 0,3,5-7.", show_default="all"),
    episodes: str | None = typer.Option(
        None, help="all (the protocol's), a count, or indices and ranges: 0,3,5-7.", show_default="all"
    ),
    policy_arg: list[str] | None = typer.Option(
        None, help="key=value for the policy; repeatable.", show_default="none"
    ),
    protocol: str | None = typer.Option(
        None, help="Evaluation protocol; `vecenv list --protocols` has them.", show_default="seed"
    ),
    backend: str | None = typer.Option(None, help="Physics backend.", show_default="native"),
    max_steps: int | None = typer.Option(None, min=1, help="Step budget of an episode.", show_default="the protocol's"),
    seed: int | None = typer.Option(None, help="Seed of environment and policy.", show_default="the protocol's"),
    env_arg: list[str] | None = typer.Option(None, help="key=value for vecenv.make; repeatable.", show_default="none"),
    num_envs: int | None = typer.Option(
        None, min=1, help="Most episodes that run at once.", show_default="the suite's"
    ),
    num_threads: int | None = typer.Option(
        None, min=1, help="Threads of the physics (SIMPLER: processes).", show_default="the backend's"
    ),
    out: Path | None = typer.Option(None, help="Results folder to make.", show_default="results/TIME_SUITE_POLICY"),
    resume: Path | None = typer.Option(
        None, help="Results folder to go on with; it keeps its settings.", show_default="none"
    ),
    record: bool = typer.Option(False, "--record", help="Keep the executed actions, for `vecenv replay`."),
    record_states: bool = typer.Option(False, "--record-states", help="Keep the states too; implies --record."),
    fail_fast: bool = typer.Option(False, "--fail-fast", help="Stop at the first batch that raises."),
    quiet: bool = typer.Option(False, "--quiet", help="Print the path of the results folder and nothing else."),
) -> None:
    """Evaluate a policy on a suite: success rates with Wilson 95 % intervals."""
    asked = {
        "suite": suite,
        "policy": policy,
        "tasks": tasks,
        "episodes": episodes,
        "policy_args": _pairs("--policy-arg", policy_arg),
        "protocol": protocol,
        "backend": backend,
        "max_steps": max_steps,
        "seed": seed,
        "env_args": _pairs("--env-arg", env_arg),
    }
    how = {"num_envs": num_envs, "num_threads": num_threads, "fail_fast": fail_fast}
    how |= {"record": record or None, "record_states": record_states or None}
    sys.path.append(str(Path.cwd()))  # so that --policy module:Class finds a module beside the user
    with _user_errors():
        evaluation, store = _resume(resume, {**asked, "out": out}, how) if resume else _start({**asked, **how}, out)
    raise typer.Exit(_run(evaluation, store, quiet))


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
    from vecenv_eval.demos.replay import ReplayConfig, ReplayError, find_files, read_files, replay

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
    from vecenv_eval.demos.replay import closing_line, table

    if report.outcomes:
        console.print(table(report))
    for problem in report.problems:
        console.print(f"error: {problem}", style="red", markup=False, highlight=False, soft_wrap=True)
    console.print(closing_line(report), highlight=False, soft_wrap=True)


def _start(arguments: dict[str, Any], out: Path | None) -> tuple[Evaluation, ResultStore]:
    """A new evaluation; no folder is made before the arguments are known to make sense."""
    from vecenv_eval.runner import EvalConfig, Evaluation, begin, default_policy
    from vecenv_eval.store import default_folder

    if not arguments["suite"]:
        fail("--suite is needed; `vecenv list` names the suites (or --resume goes on with a results folder)")
    arguments = {"policy": default_policy(arguments["suite"])} | {k: v for k, v in arguments.items() if v is not None}
    config = EvalConfig(**arguments)
    evaluation = Evaluation(config)
    return evaluation, begin(config, out or default_folder(RESULTS, config.suite, config.policy))


def _resume(folder: Path, asked: dict[str, Any], how: dict[str, Any]) -> tuple[Evaluation, ResultStore]:
    """An evaluation that goes on; what decides its results is in the folder and cannot be given again."""
    from vecenv_eval.runner import Evaluation, go_on

    given = [_FLAGS.get(key, f"--{key.replace('_', '-')}") for key, value in asked.items() if value is not None]
    if given:
        fail(f"--resume keeps the settings of {folder}: leave out {', '.join(given)}")
    config, store = go_on(folder, **how)
    return Evaluation(config), store


@contextmanager
def _user_errors() -> Iterator[None]:
    """What the user got wrong becomes one line and exit status 2."""
    from vecenv_eval.episodes import SpecError
    from vecenv_eval.policies import PolicyError
    from vecenv_eval.runner import ConfigError
    from vecenv_eval.store import StoreError

    try:
        yield
    except (ConfigError, PolicyError, SpecError, StoreError) as error:
        fail(" ".join(str(error).split()))


def _run(evaluation: Evaluation, store: ResultStore, quiet: bool) -> int:
    """Run, print, and say how the process should exit."""
    from rich.console import Console

    console = Console(quiet=quiet)
    with _user_errors(), _progress(console) as on_progress:
        result = evaluation.run(store, on_progress)
    _print_result(console, result)
    typer.echo(result.folder)
    return 130 if result.interrupted else 0 if result.ok else 1


def _print_result(console: Console, result: EvalResult) -> None:
    from vecenv_eval.report import STAND_INS, closing_line, stand_in_lines, table

    console.print(table(result.summary))
    console.print(closing_line(result.summary), highlight=False, soft_wrap=True)
    if result.summary.stand_ins:
        console.print(f"{STAND_INS}:", style="yellow")
    for line in stand_in_lines(result.summary):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    for cause in result.causes:
        console.print(f"error in a batch: {cause}", style="red", markup=False, highlight=False, soft_wrap=True)
    if not result.ok:
        again = f"Episodes lack a verdict; to run them: vecenv eval --resume {result.folder}"
        console.print(again, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[Progress], None]]:
    """A progress bar on a terminal, now and then a line elsewhere."""
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
        through = now.done + now.errors
        if now.setting_up or through >= self._next * now.total:
            self._console.print(f"{through}/{now.total} episodes, {_describe(now)}", highlight=False)
            self._next = through / now.total + _SHARE


def _describe(now: Progress) -> str:
    batch = f"batch {now.batch + 1}/{now.num_batches}"
    if now.setting_up:
        return f"{batch}: setting up"
    problems = "".join(f", {n} {what}" for n, what in ((now.faults, "faulted"), (now.errors, "failed")) if n)
    speed = now.steps / now.seconds if now.seconds else 0.0
    return f"{batch}: {now.successes} solved{problems}, {speed:,.0f} steps/s"


def _pairs(flag: str, texts: list[str] | None) -> dict[str, Any] | None:
    """``["a=1", "b=x"]`` as ``{"a": 1, "b": "x"}``: values are read as JSON where they are JSON, else kept as text."""
    if not texts:
        return None
    pairs = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not (equals and key.isidentifier()):
            fail(f"{flag} {text!r}: write key=value")
        pairs[key] = _value(value)
    return pairs


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
