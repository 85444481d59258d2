"""LIBERO and LIBERO-PRO as a family of suites, for ``vecenv.registry``. Imports nothing heavy before ``make``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vecenv import protocols
from vecenv.libero.tasks import suites
from vecenv.libero.tasks.suites import list_suites, list_tasks

if TYPE_CHECKING:
    from vecenv.libero.config import LiberoConfig
    from vecenv.libero.env import LiberoEnv

__all__ = ["config_type", "eval_metadata", "list_suites", "list_tasks", "make"]


def config_type() -> type[LiberoConfig]:
    """The options of a LIBERO batch."""
    from vecenv.libero.config import LiberoConfig

    return LiberoConfig


def make(suite: str, tasks: object, episodes: object, config: LiberoConfig) -> LiberoEnv:
    """A batch of LIBERO episodes; ``vecenv.make`` documents the arguments."""
    from vecenv.libero.env import make

    return make(suite, tasks=tasks, episodes=episodes, config=config)


def eval_metadata(suite: str, protocol: str) -> dict[str, object]:
    """What ``vecenv.eval_metadata`` returns of a LIBERO suite."""
    chosen = protocols.protocol(protocol, protocols.LIBERO)
    tasks = list_tasks(suite)
    episodes = chosen.episodes or suites.NUM_EPISODES
    return {
        "suite": suite,
        "protocol": chosen.to_dict(),
        "num_tasks": len(tasks),
        "episodes_per_task": episodes,
        "num_episodes": len(tasks) * episodes,
        "max_steps": chosen.horizon_of(suite),
        "metrics": ("success", "num_steps", "cumulative_reward"),
        "action_space": ("step_continuous", "step_ee_pose"),
        "control_hz": 20,
        "instructions": tuple(task.instruction for task in tasks),
    }
