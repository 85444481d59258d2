"""The command ``vecenv assets``: fetches SIMPLER's meshes, images and robot descriptions."""

from __future__ import annotations

import sys
from pathlib import Path

import typer

from vecenv.simpler.assets.files import VARIABLE, VARIANTS_MANIFEST, ManifestError, default_root, read_manifest

assets_app = typer.Typer(no_args_is_help=True)
# What can be pulled -> its manifest; None for the one that ``pull`` takes by default.
_SETS = {"simpler": None, "simpler-variants": VARIANTS_MANIFEST}


@assets_app.callback()
def _assets() -> None:
    """Meshes, images and robot descriptions."""


@assets_app.command("pull")
def pull_command(
    what: str = typer.Argument(..., help=f"Which assets: {', '.join(_SETS)}."),
    source: str | None = typer.Option(
        None, "--from", metavar="DIR|URL", help="The only folder, archive or web address to take them from."
    ),
    to: str | None = typer.Option(
        None, "--to", metavar="DIR", help=f"Folder to fill; by default {VARIABLE} or the user's data folder."
    ),
) -> None:
    """Fetch assets: intact files are kept, partial downloads are resumed, everything is verified."""
    from rich.progress import Progress

    try:
        from vecenv.simpler.assets import pull
    except ImportError as error:
        typer.echo(f"error: downloading needs {error.name!r}: pip install 'vecenv[simpler]'", err=True)
        raise typer.Exit(1) from None
    if what not in _SETS:
        raise typer.BadParameter(f"{what!r}; known: {', '.join(_SETS)}", param_hint="WHAT")
    for value, hint in ((source, "--from"), (to, "--to")):
        if value is not None and not value.strip():
            raise typer.BadParameter(f"{value!r} is empty", param_hint=hint)
    manifest = _SETS[what]
    try:
        with Progress(transient=True, disable=not sys.stderr.isatty()) as bars:
            bar = bars.add_task(what)
            report = pull.pull(
                default_root() if to is None else Path(to).expanduser(),
                source,
                manifest=read_manifest(manifest) if manifest else None,
                progress=lambda done, total: bars.update(bar, completed=done, total=total),
            )
    except (pull.PullError, ManifestError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(1) from None
    for line in report.lines():
        typer.echo(line)
    raise typer.Exit(0 if report.complete else 1)
