"""``vecenv video``: a policy runs one batch, and what its cameras see becomes one mp4.

In: a suite, a task, a policy. Out: the file. LIBERO's images have the size and detail that are asked for; SIMPLER's are
as large as its camera's, and its videos run at its robots' 5 or 3 ticks a second.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

# What LIBERO's videos are like unless something else is asked for.
_SIZE, _LOD, _MAX_STEPS = 256, "exact", 400


def video_command(
    suite: str = typer.Option(..., help="Suite; `vecenv list` names them."),
    task: str = typer.Option("0", help="Task, by index or name."),
    episodes: int = typer.Option(1, min=1, max=50, help="How many episodes, from the first; all in one picture."),
    policy: str | None = typer.Option(
        None,
        help="random, zero, pick_place (LIBERO), simpler_scripted, or your own module:Class.",
        show_default="the suite's scripted one",
    ),
    max_steps: int | None = typer.Option(
        None, min=1, help="Step budget of an episode.", show_default=f"{_MAX_STEPS}; SIMPLER: the task's"
    ),
    camera: list[str] = typer.Option(["agentview"], help="A camera; repeatable, side by side."),
    size: int | None = typer.Option(
        None, min=16, help="LIBERO: height and width of an image, pixels.", show_default=str(_SIZE)
    ),
    lod: str | None = typer.Option(
        None, help="LIBERO: exact, original (all triangles) or fast (simplified meshes).", show_default=_LOD
    ),
    out: Path = typer.Option(Path("video.mp4"), help="The file to write."),
) -> None:
    """Film a policy: all episodes of a batch in one mp4, titled, framed by verdict."""
    from vecenv.cli import fail
    from vecenv.contract import ImagesUnavailable
    from vecenv.libero.render.gl import GlError
    from vecenv.libero.render.options import RenderError
    from vecenv_eval.config import default_policy
    from vecenv_eval.policies import PolicyError, make_policy

    options = {"max_steps": max_steps, "size": size, "lod": lod}
    try:
        actor = make_policy(policy or default_policy(suite))
        env = _environment(suite, task, episodes, {name: value for name, value in options.items() if value is not None})
    except (PolicyError, ValueError, LookupError) as error:
        fail(str(error))
    try:
        frames = film(env, actor, out, camera)
        solved = int(env.evaluate().success.sum())
    except (GlError, RenderError, ImagesUnavailable, KeyError) as error:
        fail(str(error), code=1)
    finally:
        env.close()
    typer.echo(f"{out}: {frames} frames, {solved} of {episodes} episodes solved")


def film(env: Any, actor: Any, out: Path, cameras: list[str]) -> int:
    """Run a batch from its beginning to its end and film it, at the robot's own rate.

    Args:
        env: an environment as ``vecenv.make`` returns it.
        actor: a policy (``vecenv_eval.policies``).
        out: the mp4.
        cameras: shown side by side.

    Returns:
        How many frames were written: one a control tick, and one that shows how things ended.
    """
    from vecenv.contract import Control
    from vecenv_eval.film import CONTROL_HZ, recording

    actor.reset(env, env.reset())
    rate = env.robot.control_hz if hasattr(env, "robot") else CONTROL_HZ
    with recording(env, out, cameras=cameras, fps=rate) as video:
        done = False
        while not done:
            acted = actor.act(env)
            control = acted if isinstance(acted, Control) else env.step_continuous(acted)
            done = bool(control.done.all())
    return video.frames


def _environment(suite: str, task: str, episodes: int, options: dict[str, Any]) -> Any:
    """The batch to film; ``options`` has only what was asked for.

    Raises:
        ValueError, LookupError: something that does not exist, or that the suite does not have.
    """
    import vecenv
    from vecenv.libero.render.options import RenderConfig

    chosen = int(task) if task.isdecimal() else task
    if suite.split("/")[0] == "simpler":
        given = [f"--{name}" for name in ("size", "lod") if name in options]
        if given:
            raise ValueError(f"{' and '.join(given)}: SIMPLER's images are as large and as detailed as upstream's")
        return vecenv.make(suite, task=chosen, episodes=range(episodes), **options)
    size, lod = options.pop("size", _SIZE), options.pop("lod", _LOD)
    render = RenderConfig(height=size, width=size, lod=lod)
    return vecenv.make(
        suite, task=chosen, episodes=range(episodes), render=render, **{"max_steps": _MAX_STEPS, **options}
    )
