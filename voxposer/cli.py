"""The ``vecenv voxposer`` commands; what they need is imported when one runs."""

from __future__ import annotations

from pathlib import Path

import typer

voxposer_app = typer.Typer(
    help="The VoxPoser planner. Its programs are written by a rule base, not by a language model, unless one is named.",
    no_args_is_help=True,
)


@voxposer_app.callback()
def _group() -> None:
    """Without a callback, typer would make the only command the group itself."""


@voxposer_app.command("show")
def show_command(
    task: str = typer.Argument(..., help="SUITE/TASK or SUITE/TASK/EPISODE, such as libero_goal/0."),
    model: str = typer.Option(
        "offline/libero",
        help="litellm's name of the model that writes the programs; the default is a rule base, no language model.",
    ),
    out: Path = typer.Option(Path("voxposer_show"), help="Folder to write to."),
    prompts_dir: Path | None = typer.Option(None, help="Folder of prompts to use.", show_default="the package's"),
) -> None:
    """Plan and follow a task once; write its maps, paths and programs as an HTML page and a PNG."""
    from vecenv.cli import fail
    from vecenv.errors import InvalidInput
    from voxposer.show import parse_task, record_episode, render_page, save_image

    try:
        suite, number, episode = parse_task(task)
    except InvalidInput as error:
        fail(str(error))
    shown = record_episode(suite, number, episode, model=model, prompts_dir=prompts_dir)
    out.mkdir(parents=True, exist_ok=True)
    stem = out / shown.title.replace("/", "_")
    page, picture = stem.with_suffix(".html"), stem.with_suffix(".png")
    page.write_text(render_page(shown), encoding="utf-8")
    save_image(shown, picture)
    typer.echo(f"{'solved' if shown.success else 'not solved'} in {shown.ticks} ticks {shown.cause}".rstrip())
    typer.echo(page)
    typer.echo(picture)
