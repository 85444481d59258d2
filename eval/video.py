"""``vecenv video``: a policy runs one batch, and what its cameras see becomes one mp4."""

from __future__ import annotations

from pathlib import Path

import typer


def video_command(
    suite: str = typer.Option(..., help="Suite; `vecenv list` names them."),
    task: int = typer.Option(0, min=0, help="Task index."),
    episodes: int = typer.Option(1, min=1, max=50, help="How many episodes, from the first; all in one picture."),
    policy: str = typer.Option("pick_place", help="random, zero, pick_place, or your own module:Class."),
    max_steps: int = typer.Option(400, min=1, help="Step budget of an episode."),
    camera: list[str] = typer.Option(["agentview"], help="A camera; repeatable, side by side."),
    size: int = typer.Option(256, min=16, help="Height and width of an image, pixels."),
    lod: str = typer.Option("exact", help="exact, original (all triangles) or fast (simplified meshes)."),
    out: Path = typer.Option(Path("video.mp4"), help="The file to write."),
) -> None:
    """Film a policy: all episodes of a batch in one mp4, titled, framed by verdict."""
    import vecenv
    from eval.policies import PolicyError, make_policy
    from vecenv.cli import fail
    from vecenv.contract import Control, ImagesUnavailable
    from vecenv.render.gl import GlError
    from vecenv.render.options import RenderConfig, RenderError
    from vecenv.render.video import recording

    try:
        actor = make_policy(policy)
        render = RenderConfig(height=size, width=size, lod=lod)
        env = vecenv.make(suite, task=task, episodes=range(episodes), max_steps=max_steps, render=render)
    except (PolicyError, ValueError, KeyError) as error:
        fail(str(error))
    try:
        actor.reset(env, env.reset())
        with recording(env, out, cameras=camera) as video:
            done = False
            while not done:
                acted = actor.act(env)
                control = acted if isinstance(acted, Control) else env.step_continuous(acted)
                done = bool(control.done.all())
        solved = int(env.evaluate().success.sum())
    except (GlError, RenderError, ImagesUnavailable, KeyError) as error:
        fail(str(error), code=1)
    finally:
        env.close()
    typer.echo(f"{out}: {video.frames} frames, {solved} of {episodes} episodes solved")
