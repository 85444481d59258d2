"""``vecenv compile``, LIBERO suites exported into a folder; ``vecenv warmup``, caches filled ahead."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from vecenv.cli import fail
from vecenv.util.names import unknown

if TYPE_CHECKING:
    from rich.console import Console

    from vecenv.libero.warmup import Warmup

_NO_IMAGES = "none"


def compile_command(
    out: Path = typer.Option(..., "--out", metavar="DIR", help="Folder to write; make(..., scenes=DIR) reads it."),
    suite: list[str] = typer.Option(
        [], "--suite", help="A LIBERO suite to export; may be given again. All by default."
    ),
    geometry: list[str] = typer.Option(
        ["exact"], "--geometry", help="exact, or lean, which brings exact with it; may be given again."
    ),
    contacts: str = typer.Option("published", "--contacts", help="published or current."),
    images: list[str] = typer.Option(
        [],
        "--images",
        help="Also what camera images show, for RenderConfig(engine=...): gl or raytrace; may be given again.",
    ),
    lod: list[str] = typer.Option(
        [],
        "--lod",
        help="Level of detail of images: original, exact or fast; may be given again. By default exact, and for "
        "raytrace fast as well, which the functional environment draws.",
    ),
    colors: list[str] = typer.Option(
        ["published"], "--colors", help="Colours of images: published or current; may be given again."
    ),
    budgets: bool = typer.Option(
        False,
        "--budgets",
        help="Also the contact memory that MJX needs, which takes up to a minute a scene to measure.",
    ),
) -> None:
    """Export LIBERO suites into one folder that needs no LIBERO or robosuite files: tasks, starts, scenes, images."""
    from rich.console import Console
    from rich.progress import track

    import vecenv
    from vecenv.libero.contact_memory import export_budgets
    from vecenv.libero.render.exported import export_images, looks
    from vecenv.libero.render.options import RenderError
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
    if lod and not images:
        fail("--lod: a level of detail of images, which --images asks for")
    console = Console(stderr=True)
    bar = functools.partial(track, console=console, disable=not console.is_terminal)
    try:
        chosen = looks(images, lod, colors)
    except RenderError as error:
        fail(str(error))
    try:
        done = export(
            out,
            suite or None,
            geometries=geometry,
            contacts=contacts,  # type: ignore[arg-type]  # checked there
            track=bar,
        )
        drawn = export_images(out, chosen, suite or None, track=bar) if chosen else None
        measured = export_budgets(out, suite or None, track=bar) if budgets else 0
    except ExportError as error:
        fail(str(error))
    except (BDDLError, SceneError, SettledStartsError, TaskDataError, OSError) as error:
        fail(str(error), code=1)
    counts = f"suites: {done.suites}, tasks: {done.tasks}, scenes: {done.scenes}"
    typer.echo(f"{counts}, {done.size / 1e6:.0f} MB in {done.folder}")
    if drawn is not None:
        what = ", ".join(map(str, chosen))
        typer.echo(f"images ({what}): scenes: {drawn.scenes}, {drawn.size / 1e6:.0f} MB in {done.folder}")
    if budgets:
        typer.echo(f"contact memory: scenes: {measured}")


def warmup_command(
    suite: list[str] = typer.Option(..., "--suite", help="A LIBERO suite; may be given again."),
    task: str = typer.Option("all", "--task", help="Only the scenes of these tasks: all, or 0,3,5-7."),
    backend: str = typer.Option("warp", "--backend", help="native, warp, jax or mjx."),
    geometry: str = typer.Option("exact", "--geometry", help="exact or lean."),
    contacts: str = typer.Option("published", "--contacts", help="published or current."),
    num_envs: list[int] = typer.Option(
        [1],
        "--num-envs",
        help="Slots of a scene in a batch; may be given again. XLA's programs are compiled for each number, Warp's "
        "kernels, the larger part, are the same for all.",
    ),
    chunk: list[int] = typer.Option(
        [1], "--chunk", help="Actions that a call of step_continuous gets; may be given again. Likewise."
    ),
    images: str = typer.Option("none", "--images", help="Also what images need: none, gl or raytrace."),
    image_size: int = typer.Option(256, "--image-size", help="Height and width of the images, pixels."),
    lod: str = typer.Option("exact", "--lod", help="Level of detail of the images: original, exact or fast."),
    scenes: Path | None = typer.Option(None, "--scenes", help="A folder that vecenv compile wrote."),
    jobs: int | None = typer.Option(None, "--jobs", help="Scenes at once.", show_default="by cores and memory"),
    as_json: bool = typer.Option(False, "--json", help="Print one JSON object a line instead."),
) -> None:
    """Compile ahead what environments compile before their first step, so that their caches are full."""
    from rich.console import Console

    import vecenv
    from vecenv.libero.render.options import ENGINES
    from vecenv.libero.warmup import Warmup, scenes_of
    from vecenv.util import caching

    folder = caching.folder("")
    if folder is None:
        fail(f"{caching.VARIABLE} is set to nothing, which turns the caches off")
    for name in suite:
        if name not in vecenv.list_suites("libero"):
            fail(unknown("suite", name, vecenv.list_suites("libero")))
    if images not in (_NO_IMAGES, *ENGINES):
        fail(unknown("kind of images", images, (_NO_IMAGES, *ENGINES)))
    options: dict[str, Any] = {"backend": backend, "geometry": geometry, "contacts": contacts}
    if scenes is not None:
        options["scenes"] = str(scenes)
    if images != _NO_IMAGES:
        options["render"] = {"engine": images, "height": image_size, "width": image_size, "lod": lod}
    for name in suite:
        vecenv.make_config(name, options)  # refuses what no environment takes
    if jobs is not None and jobs < 1:
        fail(f"--jobs {jobs}: need at least 1")
    sizes: dict[str, Any] = {"num_envs": tuple(num_envs), "chunks": tuple(chunk), "images": images != _NO_IMAGES}
    wanted = [
        Warmup(suite=name, task=index, options=options, **sizes)
        for name in dict.fromkeys(suite)
        for index in scenes_of(name, task, options.get("scenes"))
    ]
    show = _json_lines if as_json else functools.partial(_bar, Console(stderr=True))
    failed = show(wanted, jobs)
    if not as_json:
        typer.echo(f"{len(wanted) - failed} of {len(wanted)} scenes are ready; caches: {folder}")
    raise typer.Exit(1 if failed else 0)


def _bar(console: Console, wanted: Sequence[Warmup], jobs: int | None) -> int:
    """Make scenes ready and show a bar; returns how many failed, which are named at the end."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from vecenv.libero.warmup import warm

    columns = TextColumn("scenes"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    plain: dict[str, Any] = {"markup": False, "highlight": False, "soft_wrap": True}
    failed: list[str] = []
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        row = bar.add_task("scenes", total=len(wanted))
        for count, done in enumerate(warm(wanted, jobs=jobs, say=lambda text: console.print(text, **plain)), start=1):
            bar.advance(row)
            said = f"failed: {done.error}" if done.error else f"ready after {done.seconds:.1f} s"
            console.print(f"{done.what.name}: {said} ({count}/{len(wanted)})", **plain)
            failed += [f"{done.what.name}: {done.error}"] if done.error else []
    for line in failed:
        console.print(f"not ready: {line}", style="red", **plain)
    return len(failed)


def _json_lines(wanted: Sequence[Warmup], jobs: int | None) -> int:
    """Make scenes ready and print a line for each, and for each report; returns how many failed."""
    from vecenv.libero.warmup import warm

    def line(event: str, **fields: Any) -> None:
        typer.echo(json.dumps({"event": event, **fields}))

    failed = 0
    for done in warm(wanted, jobs=jobs, say=lambda text: line("report", text=text)):
        failed += bool(done.error)
        row = {"suite": done.what.suite, "task": done.what.task, "seconds": round(done.seconds, 1)}
        line("scene", **row, error=done.error)
    line("end", scenes=len(wanted), failed=failed)
    return failed
