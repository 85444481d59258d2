"""``vecenv video``: a policy runs one batch of episodes, recorded in one mp4.

In: a suite, a task, a policy. Out: the file and a line that says how many episodes were solved. The exit status is 2
when the arguments are wrong and 1 when images cannot be rendered or written.
"""

from __future__ import annotations

from pathlib import Path

import typer

from vecenv_eval.video import LOD, MAX_STEPS, SIZE


def video_command(
    suite: str = typer.Option(..., help="Suite; `vecenv list` names them."),
    task: str = typer.Option("0", help="Task, by index or name."),
    episodes: int = typer.Option(1, min=1, max=50, help="How many episodes, from the first; all in one image."),
    policy: str | None = typer.Option(
        None,
        help="random, zero, pick_place (LIBERO), simpler_scripted, or your own module:Class.",
        show_default="the suite's scripted one",
    ),
    max_steps: int | None = typer.Option(
        None, min=1, help="Step budget of an episode.", show_default=f"{MAX_STEPS}; SIMPLER: the task's"
    ),
    camera: list[str] = typer.Option(["agentview"], help="A camera; repeatable, side by side."),
    size: int | None = typer.Option(
        None, min=16, help="LIBERO: height and width of an image, pixels.", show_default=str(SIZE)
    ),
    lod: str | None = typer.Option(
        None, help="LIBERO: exact, original (all triangles) or fast (simplified meshes).", show_default=LOD
    ),
    out: Path = typer.Option(Path("video.mp4"), help="The file to write."),
) -> None:
    """Record a policy: all episodes of a batch in one mp4, titled, framed by verdict."""
    from vecenv.cli import fail
    from vecenv.libero.render.gl import GlError
    from vecenv.libero.render.options import RenderError
    from vecenv.observations import ImagesUnavailable
    from vecenv_eval.policies import PolicyError, make_policy
    from vecenv_eval.runner import default_policy
    from vecenv_eval.video.episodes import make_env, record_rollout

    options = {"max_steps": max_steps, "size": size, "lod": lod}
    try:
        chosen = make_policy(policy or default_policy(suite))
        env = make_env(suite, task, episodes, {name: value for name, value in options.items() if value is not None})
    except (PolicyError, ValueError, LookupError) as error:
        fail(str(error))
    try:
        frames = record_rollout(env, chosen, out, camera)
        solved = int(env.evaluate().success.sum())
    except (GlError, RenderError, ImagesUnavailable, KeyError) as error:
        fail(str(error), code=1)
    finally:
        env.close()
    typer.echo(f"{out}: {frames} frames, {solved} of {episodes} episodes solved")
