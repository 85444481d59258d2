"""The ``vecenv`` command: ``doctor`` and ``list`` are defined here, other packages add theirs.

Exit status: 0 done, 1 an error of the machine or the run, 2 wrong arguments. Commands of other packages are found
through the entry-point group ``vecenv.commands``, so this package does not import them. Simulators are imported only
when a command runs.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import json
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from vecenv.util.names import unknown

if TYPE_CHECKING:
    from vecenv.protocols import Protocol

COMMAND_GROUP = "vecenv.commands"


def main() -> None:
    """Entry point of the ``vecenv`` console script; what is raised on purpose becomes one line and an exit status."""
    from vecenv.errors import InvalidInput, NotFound, VecenvError
    from vecenv.util.extras import EXTRAS, how_to_install

    try:
        build_app()()
    except VecenvError as error:
        typer.echo(f"error: {' '.join(str(error).split())}", err=True)
        raise SystemExit(2 if isinstance(error, InvalidInput | NotFound) else 1) from None
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if module not in EXTRAS:
            raise
        typer.echo(f"error: {how_to_install(module)}", err=True)
        raise SystemExit(1) from None
    except OSError as error:
        if error.filename is None:  # no file: something that we should know about
            raise
        typer.echo(f"error: {error.filename}: {error.strerror}", err=True)
        raise SystemExit(1) from None


def build_app(plugins: Iterable[importlib.metadata.EntryPoint] | None = None) -> typer.Typer:
    """Build the command-line application.

    Args:
        plugins: entry points to mount; those of the group ``vecenv.commands`` when not given.
    """
    app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
    app.callback()(_root)
    app.command("doctor")(doctor_command)
    app.command("list")(list_command)
    for plugin in importlib.metadata.entry_points(group=COMMAND_GROUP) if plugins is None else plugins:
        _mount(app, plugin)
    return app


def fail(message: str, code: int = 2) -> NoReturn:
    """Print one line to standard error and leave with an exit status (2: the arguments were wrong)."""
    typer.echo(f"error: {message}", err=True)
    raise typer.Exit(code)


def doctor_command(as_json: bool = typer.Option(False, "--json", help="Print one JSON object instead.")) -> None:
    """Show versions, devices, GL, Vulkan and asset trees, what is missing, and the command that installs it."""
    from rich.console import Console

    from vecenv import doctor

    report = doctor.diagnose()
    if as_json:
        typer.echo(report.to_json())
    else:
        doctor.print_report(report, Console())
    raise typer.Exit(0 if report.ok else 1)


def list_command(
    suite: str = typer.Argument("", help="A suite, to list its tasks; without it, the suites are listed."),
    protocol: bool = typer.Option(False, "--protocols", help="List the evaluation protocols instead."),
    as_json: bool = typer.Option(False, "--json", help="Print JSON instead."),
) -> None:
    """List the suites, the tasks of one suite, or the evaluation protocols and their sources."""
    import vecenv

    if protocol:
        _list_protocols(suite, as_json)
        return
    suites = tuple(vecenv.list_suites())
    if suite and suite not in suites:
        fail(unknown("suite", suite, suites))
    named = vecenv.family(suite) == "simpler"
    rows = _task_rows(vecenv.list_tasks(suite), named) if suite else _suite_rows(suites)
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        _print_rows(rows)


def _list_protocols(suite: str, as_json: bool) -> None:
    """Print every protocol, or those of a suite."""
    import vecenv
    from vecenv.protocols import PROTOCOLS

    if suite and suite not in vecenv.list_suites():
        fail(unknown("suite", suite, vecenv.list_suites()))
    families = [vecenv.family(suite)] if suite else list(PROTOCOLS)
    chosen = [each for family in families for each in PROTOCOLS[family].values()]
    if as_json:
        typer.echo(json.dumps([each.to_dict() for each in chosen], indent=2))
    else:
        _print_protocols(chosen)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(importlib.metadata.version("vecenv"))
        raise typer.Exit


def _root(
    version: bool = typer.Option(False, "--version", help="Print the version.", is_eager=True, callback=_version),
) -> None:
    """Batched robot-manipulation environments: LIBERO on MuJoCo, SIMPLER on SAPIEN, and an evaluation harness."""


def _mount(app: typer.Typer, plugin: importlib.metadata.EntryPoint) -> None:
    """Add a command (a function) or a group (a Typer); one that cannot be imported prints the reason when called."""
    try:
        command: Any = plugin.load()
    except Exception as error:  # a package that is not ours; the other commands must still work
        command = _broken(plugin, error)
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=plugin.name)
    else:
        app.command(plugin.name)(command)


def _broken(plugin: importlib.metadata.EntryPoint, error: Exception) -> Callable[[], None]:
    reason = f"{type(error).__name__}: {error}"

    def command() -> None:
        fail(f"the command {plugin.name!r} ({plugin.value}) cannot be loaded: {reason}", code=1)

    command.__doc__ = f"(cannot be loaded: {reason})"
    return command


def _suite_rows(suites: Iterable[str]) -> list[dict[str, Any]]:
    import vecenv

    return [{"suite": suite, "tasks": len(vecenv.list_tasks(suite))} for suite in suites]


def _task_rows(tasks: Iterable[Any], named: bool) -> list[dict[str, Any]]:
    """Rows of the task list; names only for SIMPLER, because LIBERO's are nearly its instructions."""
    return [
        {"task": i, **({"name": task.name} if named else {}), "instruction": task.instruction}
        for i, task in enumerate(tasks)
    ]


def _print_rows(rows: list[dict[str, Any]]) -> None:
    from rich.console import Console

    from vecenv.util.tables import from_rows

    Console().print(from_rows(rows))


def _print_protocols(chosen: Sequence[Protocol]) -> None:
    """Print a table of the values that protocols fix, then the source and note of each."""
    from rich.console import Console

    from vecenv.util.tables import from_rows

    console = Console()
    console.print(from_rows([_protocol_row(each) for each in chosen], keys=2))
    for each in chosen:
        said = "; ".join(map(str, each.sources)) + (f". {each.note}" if each.note else "")
        console.print(f"{each.family} {each.name}: {said}", markup=False, highlight=False, soft_wrap=True)


def _protocol_row(protocol: Protocol) -> dict[str, Any]:
    """Columns of the table; "-" is a value that each task decides, or that the family does not have."""
    horizon = "/".join(str(ticks) for ticks in dict(protocol.horizon).values())
    row = {
        "protocol": protocol.name,
        "suites": protocol.family,
        "horizon": horizon,
        "idle": protocol.idle_steps,
        "start": protocol.start,
        "fixtures": protocol.fixtures,
        "seed": protocol.seed,
        "episodes": protocol.episodes,
        "image": protocol.image_size,
        "success": protocol.success,
        "replan": protocol.policy.replan_steps,
    }
    return {name: "-" if value in (None, "") else value for name, value in row.items()}
