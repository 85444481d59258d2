"""``vecenv report``: a results folder as a page, or as a table to paste.

A results folder comes in, or a folder of them (one a suite), and perhaps a second one to compare with; an HTML page
goes out, or Markdown, LaTeX or CSV. The exit status is 2 when a folder cannot be
read or the arguments are wrong, and 1 when a package is missing.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

import typer

from vecenv.cli import fail


class Format(StrEnum):
    """What to write."""

    html = "html"
    markdown = "markdown"
    latex = "latex"
    csv = "csv"


def report_command(
    folder: Path = typer.Argument(..., help="Results folder of `vecenv eval`, or a folder of them, one a suite."),
    other: Path | None = typer.Argument(None, help="A second one, compared on the same episodes.", show_default="none"),
    format: Format = typer.Option(Format.html, help="What to write."),
    out: Path | None = typer.Option(
        None, help="File to write.", show_default="FOLDER/report.html; other formats: standard output"
    ),
    embed_mb: float = typer.Option(
        20.0, min=0.0, help="HTML: most megabytes of videos inside the page; further ones are linked."
    ),
) -> None:
    """Report on an evaluation: success with intervals, failures first, conditions; or compare two."""
    from vecenv.errors import MissingDependency
    from vecenv_eval.report.compare import compare
    from vecenv_eval.report.run import read_run
    from vecenv_eval.report.run_tables import latex, markdown, to_csv
    from vecenv_eval.store import StoreError

    try:
        runs = [read_run(each) for each in (folder, other) if each is not None]
    except StoreError as error:
        fail(" ".join(str(error).split()))
    if format is Format.html:
        from vecenv_eval.report.html import page

        out = out or folder / "report.html"
        try:
            text = page(*runs, out=out, embed_mb=embed_mb)
        except MissingDependency as error:
            fail(str(error), code=1)
    elif format is Format.markdown:
        text = markdown(runs, compare(*runs) if other else None)
    else:
        text = latex(runs) if format is Format.latex else to_csv(runs)
    if out is None:
        typer.echo(text, nl=False)
        return
    try:
        out.write_text(text)
    except OSError as error:
        fail(f"{out} cannot be written: {error.strerror}")
    typer.echo(out)
