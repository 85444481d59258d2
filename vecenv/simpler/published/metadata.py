"""What an evaluation of a SIMPLER suite consists of, under each protocol."""

from __future__ import annotations

from typing import Any

from vecenv.simpler.published.lists import counts
from vecenv.simpler.published.specs import SEED
from vecenv.simpler.tasks import NUM_EPISODES, list_tasks


def eval_metadata(suite: str, protocol: str = "seed") -> dict[str, Any]:
    """What an evaluation of a suite consists of, with the keys of ``vecenv.eval_metadata``; budgets are per task.

    Args:
        suite: the suite.
        protocol: one of ``published.PROTOCOLS``. Under upstream's lists ``episodes_per_task`` is a tuple, one number
            per task, 0 if upstream has none.

    Raises:
        UnknownSuite: no such suite.
        PublishedError: no such protocol, or it has no episodes of this suite.
    """
    tasks, there = list_tasks(suite), counts(protocol, suite)
    per_task = tuple(there.get(task.index, 0) for task in tasks)
    return {
        "suite": suite,
        "protocol": protocol,
        "num_tasks": len(tasks),
        "episodes_per_task": NUM_EPISODES if protocol == SEED else per_task,
        "num_episodes": sum(per_task),
        "max_steps": tuple(task.max_steps for task in tasks),
        "metrics": ("success", "num_steps", "cumulative_reward"),
        "action_space": ("step_continuous", "step_ee_pose"),
        "control_hz": tasks[0].control_hz,
        "instructions": tuple(task.instruction for task in tasks),
    }
