"""A policy runs some episodes side by side, and what its cameras see is written to one video.

In: a config, of which the episodes run at once; or an environment and a policy. Out: the file. LIBERO's images have the
size and level of detail that are requested; SIMPLER's are as large as its camera's, and its videos run at its robots' 5
or 3 control steps per second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, cast

from vecenv.contract import BatchEnv
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.drive import drive
from vecenv_eval.environments import Environments
from vecenv_eval.episodes import Stream
from vecenv_eval.policies import Closing, Policy, PolicyUnavailable, error_of
from vecenv_eval.runner import Evaluation, check_cameras
from vecenv_eval.video.film import MOST_EPISODES, Film
from vecenv_eval.video.writer import Recordable, recording


class RecordableEnv(BatchEnv, Recordable, Protocol):
    """An environment that a policy can run and ``recording`` can watch."""


def record_config(config: EvalConfig, out: Path, film: Film | None = None) -> tuple[int, int, int]:
    """Run the episodes of a config side by side and record them.

    Args:
        config: what runs; one suite. Its cameras are those that the video shows; the policy gets all.
        out: the video, .mp4 or .webp.
        film: how the episodes are shown.

    Returns:
        Frames written, episodes solved, and episodes.

    Raises:
        ConfigError, SpecError, PolicyError: something in the config does not exist or does not fit.
        GlError, RenderError: images cannot be rendered or written.
        PolicyStuck: the policy takes no steps.
        PolicyUnavailable: it could not act in some of the episodes; the video is there.
    """
    everywhere = replace(config, cameras=None)
    evaluation = Evaluation(everywhere)
    check_cameras(config, evaluation.suite, evaluation.tasks)
    planned = evaluation.planned
    try:
        if len(planned) > MOST_EPISODES:
            raise ConfigError(
                f"{len(planned)} episodes are more than the {MOST_EPISODES} that a video shows: choose some with "
                "--tasks and --episodes"
            )
        environments = Environments(evaluation.simulator, evaluation.suite, everywhere, on_make=lambda env: None)
        try:
            env = environments.place(Stream(evaluation.suite.name, planned)).env
            cameras = config.camera_names or ("agentview",)
            frames = record_rollout(cast("RecordableEnv", env), evaluation.policy, out, cameras, film)
            if errors := [text for slot in range(len(planned)) if (text := error_of(evaluation.policy, slot))]:
                raise PolicyUnavailable(f"{len(errors)} of {len(planned)} episodes have no verdict: {errors[0]}")
            return frames, int(env.evaluate().success.sum()), len(planned)
        finally:
            environments.close()
    finally:
        if isinstance(evaluation.policy, Closing):
            evaluation.policy.close()


def record_rollout(
    env: RecordableEnv, policy: Policy, out: Path, cameras: Sequence[str], film: Film | None = None
) -> int:
    """Run a batch from its start to its end and record it, by default at the robot's control rate.

    Args:
        env: an environment as ``vecenv.make`` returns it.
        policy: see ``vecenv_eval.policies``.
        out: the video, .mp4 or .webp.
        cameras: shown side by side.
        film: how the slots are shown.

    Returns:
        The number of frames written: by default one per control step, and one that shows the end.

    Raises:
        PolicyStuck: the policy takes no steps.
    """
    film = film or Film()
    policy.reset(env, env.reset())
    look = recording(
        env,
        out,
        cameras=cameras,
        columns=film.columns,
        fps=film.rate(env.control_hz),
        titles=None if film.titles else (),
        every=film.every,
        border=film.border,
        held=film.held(env.control_hz),
    )
    with look as video:
        for _ in drive(env, policy):
            pass
    return video.frames
