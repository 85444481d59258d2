"""``vecenv merge``: the parts of an evaluation, run with ``vecenv eval --shard i/n``, as one results folder.

Results folders come in; one comes out, with the table and the files that a single run would have left. The exit
status is 0 when every episode has a verdict, 1 when some have none (yet) or a package is missing, and 2 when the
folders do not belong together, or cannot be read or written.
"""

from __future__ import annotations

from pathlib import Path

import typer

from vecenv.cli import fail


def merge_command(
    out: Path = typer.Argument(..., help="Results folder to make, or one from an earlier merge to add to."),
    folders: list[Path] = typer.Argument(..., help="Results folders of one evaluation: its shards, finished or not."),
    any_versions: bool = typer.Option(
        False, "--any-versions", help="Merge although versions of simulators or numeric packages differ."
    ),
    quiet: bool = typer.Option(False, "--quiet", help="Print the path of the merged folder and nothing else."),
) -> None:
    """Join the shards of an evaluation or a campaign into one results folder."""
    from rich.console import Console
    from rich.markdown import Markdown

    from vecenv.errors import MissingDependency, VecenvError
    from vecenv_eval.campaign import markdown
    from vecenv_eval.cli.screen import print_result
    from vecenv_eval.merge import merge

    console = Console(quiet=quiet)
    try:
        merged = merge(out, folders, any_versions=any_versions)
    except MissingDependency as error:
        fail(" ".join(str(error).split()), code=1)
    except VecenvError as error:
        fail(" ".join(str(error).split()))
    except OSError as error:
        fail(f"{error.filename or out} cannot be read or written: {error.strerror}")
    for result in merged.results:
        print_result(console, result)
    if merged.summary is not None:
        console.print(Markdown(markdown(merged.summary)))
    typer.echo(merged.folder)
    raise typer.Exit(0 if merged.ok else 1)
