"""A policy runs one batch of episodes, and what its cameras see is written to one mp4.

In: an environment and a policy, or the names of a suite and a task. Out: the file. LIBERO's images have the size and
level of detail that are requested; SIMPLER's are as large as its camera's, and its videos run at its robots' 5 or 3
control steps per second.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, cast

import vecenv
from vecenv.contract import BatchEnv, Control
from vecenv.libero.render.options import RenderConfig
from vecenv_eval.policies import Policy
from vecenv_eval.video import LOD, MAX_STEPS, SIZE
from vecenv_eval.video.writer import CONTROL_HZ, Recordable, recording


class RecordableEnv(BatchEnv, Recordable, Protocol):
    """An environment that a policy can run and ``recording`` can watch."""


def record_rollout(env: RecordableEnv, policy: Policy, out: Path, cameras: Sequence[str]) -> int:
    """Run a batch from its start to its end and record it, at the robot's control rate.

    Args:
        env: an environment as ``vecenv.make`` returns it.
        policy: see ``vecenv_eval.policies``.
        out: the mp4.
        cameras: shown side by side.

    Returns:
        The number of frames written: one per control step, and one that shows the end.
    """
    policy.reset(env, env.reset())
    robot = getattr(env, "robot", None)  # SIMPLER's environments have one
    rate = CONTROL_HZ if robot is None else robot.control_hz
    with recording(env, out, cameras=cameras, fps=rate) as video:
        done = False
        while not done:
            acted = policy.act(env)
            control = acted if isinstance(acted, Control) else env.step_continuous(acted)
            done = bool(control.done.all())
    return video.frames


def make_env(suite: str, task: str, episodes: int, options: Mapping[str, Any]) -> RecordableEnv:
    """The batch to record.

    Args:
        suite: its name.
        task: index or name.
        episodes: how many, from the first.
        options: ``max_steps``, ``size`` and ``lod``, those that were given.

    Raises:
        ValueError, LookupError: a name does not exist, or the suite does not have the option.
    """
    chosen, more = int(task) if task.isdecimal() else task, dict(options)
    if suite.split("/")[0] == "simpler":
        given = [f"--{name}" for name in ("size", "lod") if name in more]
        if given:
            raise ValueError(f"{' and '.join(given)}: SIMPLER's images are as large and as detailed as upstream's")
    else:
        size = more.pop("size", SIZE)
        more["render"] = RenderConfig(height=size, width=size, lod=more.pop("lod", LOD))
        more.setdefault("max_steps", MAX_STEPS)
    return cast("RecordableEnv", vecenv.make(suite, task=chosen, episodes=range(episodes), **more))
