"""``vecenv video``: a policy runs some episodes side by side, recorded in one mp4.

The settings of ``vecenv eval`` that say what runs come in, as options or from a YAML file. Out: the file and a line
that says how many episodes were solved. The exit status is 2 when the arguments are wrong and 1 when images cannot be
rendered or written, or the policy cannot go on.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import typer

from vecenv.cli import fail
from vecenv_eval.cli.options import some_settings, user_errors, with_settings
from vecenv_eval.config import ConfigError, EvalConfig

# Step budget of LIBERO's videos, control ticks.
_MAX_STEPS = 400
SETTINGS = (
    *("suite", "policy", "tasks", "episodes", "policy_args", "protocol", "backend", "max_steps", "seed"),
    *("image_size", "lod", "colors", "cameras", "env_args", "num_threads"),
)
_ALSO = {"tasks": "--task", "image_size": "--size", "cameras": "--camera"}
# One task's first episode, unless others are asked for.
_USUAL = {"tasks": "0", "episodes": "1"}
_SHOWN = {
    **_USUAL,
    "max_steps": f"{_MAX_STEPS} in LIBERO without --protocol; else the protocol's",
    "cameras": "agentview",
}
_HELPS = {
    "suite": "Suite; `vecenv list` names them.",
    "cameras": "Cameras that the video shows, side by side; repeatable, or a,b.",
}


@partial(with_settings, names=SETTINGS, also=_ALSO, shown=_SHOWN, helps=_HELPS)
def video_command(
    config: Path | None = typer.Option(
        None, help="YAML file of settings, by the names of EvalConfig's fields; options override it."
    ),
    out: Path = typer.Option(Path("video.mp4"), help="The file to write."),
    **settings: Any,
) -> None:
    """Record a policy: some episodes side by side in one mp4, titled, framed by verdict."""
    sys.path.append(str(Path.cwd()))  # so that --policy module:Class finds a module beside the user
    with user_errors():
        given = {**_USUAL, **some_settings(settings, config, SETTINGS, "video")}
        if out.suffix != ".mp4":
            fail(f"--out {out}: videos are written as .mp4")
        if not given.get("suite"):
            fail("--suite is needed; `vecenv list` names the suites")
        from vecenv_eval.rollout import record_config

        frames, solved, count = record_config(_with_budget(EvalConfig.from_dict(given), "protocol" in given), out)
    typer.echo(f"{out}: {frames} frames, {solved} of {count} episodes solved")


def _with_budget(config: EvalConfig, protocol_given: bool) -> EvalConfig:
    """The config with the step budget of a video, where neither it nor a protocol says another."""
    from dataclasses import replace

    import vecenv

    if len(config.suites) != 1:
        raise ConfigError(f"--suite {config.suite}: a video shows one suite")
    if config.max_steps is None and not protocol_given and vecenv.family(config.suite) == "libero":
        return replace(config, max_steps=_MAX_STEPS)
    return config
