"""``vecenv export``: the rows of a results folder, or of a campaign, as one table in a file.

The exit status is 2 when the folder cannot be read or the arguments are wrong, and 1 when a package is missing.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

import typer

from vecenv.cli import fail


class Format(StrEnum):
    """What to write."""

    csv = "csv"
    parquet = "parquet"
    jsonl = "jsonl"
    sqlite = "sqlite"


def export_command(
    folder: Path = typer.Argument(..., help="Results folder of `vecenv eval`, or a campaign's."),
    format: Format = typer.Option(..., help="What to write."),
    out: Path | None = typer.Option(None, help="File to make.", show_default="FOLDER/export.FORMAT"),
) -> None:
    """Export every episode as one table: a row an episode, with suite and seed."""
    from vecenv.errors import MissingDependency, VecenvError
    from vecenv_eval.export import export

    out = out or folder / f"export.{format.value}"
    try:
        export(folder, format.value, out)
    except MissingDependency as error:
        fail(str(error), code=1)
    except VecenvError as error:
        fail(" ".join(str(error).split()))
    typer.echo(out)
