"""``vecenv compile``: LIBERO suites exported into a folder."""

from __future__ import annotations

import functools
from pathlib import Path

import typer

from vecenv.cli import fail
from vecenv.util.names import unknown


def compile_command(
    out: Path = typer.Option(..., "--out", metavar="DIR", help="Folder to write; make(..., scenes=DIR) reads it."),
    suite: list[str] = typer.Option(
        [], "--suite", help="A LIBERO suite to export; may be given again. All by default."
    ),
    geometry: list[str] = typer.Option(
        ["exact"], "--geometry", help="exact, or lean, which brings exact with it; may be given again."
    ),
    contacts: str = typer.Option("published", "--contacts", help="published or current."),
) -> None:
    """Export LIBERO suites into one folder that needs no LIBERO or robosuite files: tasks, starts, compiled scenes."""
    from rich.console import Console
    from rich.progress import track

    import vecenv
    from vecenv.libero.scene.bddl_syntax import BDDLError
    from vecenv.libero.scene.contacts import CONTACTS
    from vecenv.libero.scene.lean.geometry import PROFILES
    from vecenv.libero.scene.scene import SceneError
    from vecenv.libero.tasks.export import ExportError, export
    from vecenv.libero.tasks.settled import SettledStartsError
    from vecenv.libero.tasks.suites import TaskDataError

    for name in suite:
        if name not in vecenv.list_suites("libero"):
            fail(unknown("suite", name, vecenv.list_suites("libero")))
    for name in geometry:
        if name not in PROFILES:
            fail(unknown("geometry", name, PROFILES))
    if contacts not in CONTACTS:
        fail(unknown("contacts", contacts, CONTACTS))
    console = Console(stderr=True)
    try:
        done = export(
            out,
            suite or None,
            geometries=geometry,
            contacts=contacts,  # type: ignore[arg-type]  # checked there
            track=functools.partial(track, console=console, disable=not console.is_terminal),
        )
    except ExportError as error:
        fail(str(error))
    except (BDDLError, SceneError, SettledStartsError, TaskDataError, OSError) as error:
        fail(str(error), code=1)
    counts = f"suites: {done.suites}, tasks: {done.tasks}, scenes: {done.scenes}"
    typer.echo(f"{counts}, {done.size / 1e6:.0f} MB in {done.folder}")
