"""What ``examples/ppo.py`` has learnt, as a policy of ``vecenv eval``: on any backend and geometry.

    cd examples
    vecenv eval --suite libero_object --tasks 0 --episodes 25-49 \\
        --policy ppo_policy:PpoPolicy --policy-arg folder=../runs/goal

In: the folder of a run, or one with a folder ``task_N`` for each task. Out: the mean actions of what was learnt. The
evaluation's own scenes are simulated; of the scene that was trained on only the order of the observation is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import ppo

from vecenv.contract import ACTION_DIM, BatchEnv, ResetInfo
from vecenv.libero.env import LiberoEnv
from vecenv.libero.functional import FunctionalLibero
from vecenv.libero.physics.budgets import Budget


@dataclass(frozen=True)
class _Learnt:
    """What was learnt of one task: the environment, a function from observations to actions, ticks an action lasts."""

    env: FunctionalLibero
    act: Any
    repeat: int


class PpoPolicy:
    """Acts as learnt, without noise.

    Args:
        folder: what ``examples/ppo.py --out`` wrote.

    Raises:
        RunError: there is no such run, or it was not trained on vectors.
    """

    name = "ppo"

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)
        if not self._folder.is_dir():
            raise ppo.RunError(f"folder={folder}: there is no such folder")
        self._learnt: dict[int, _Learnt] = {}

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        """Load what the tasks of the batch need."""
        del info
        for task in np.unique(env.placement.task).tolist():
            if task not in self._learnt:
                self._learnt[task] = self._load(env.suite, task)

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        """Likewise; nothing is remembered of an episode."""
        del slots
        self.reset(env, info)

    def act(self, env: BatchEnv) -> np.ndarray:
        """Mean actions, [B, repeat, 7]."""
        assert isinstance(env, LiberoEnv)
        tasks = env.placement.task
        learnt = {task: self._learnt[task] for task in np.unique(tasks[~env.done]).tolist()}
        repeat = min((one.repeat for one in learnt.values()), default=1)
        actions = np.zeros((env.num_envs, repeat, ACTION_DIM))
        for task, one in learnt.items():
            slots = np.flatnonzero((tasks == task) & ~env.done)
            actions[slots] = np.asarray(one.act(one.env.observe_batch(env.physics, slots.tolist())))[:, None]
        return actions

    def _load(self, suite: str, task: int) -> _Learnt:
        folder = self._folder / f"task_{task}"
        folder = folder if folder.is_dir() else self._folder
        args = ppo.parser().parse_args(["--out", str(folder)])
        for name, value in ppo.settings(folder).items():
            setattr(args, name, value)
        if (args.suite, args.task) != (suite, task):
            raise ppo.RunError(f"{folder} was trained on {args.suite} {args.task}, not on {suite} {task}")
        if args.obs != "state" or args.action not in ("position", "osc"):
            raise ppo.RunError(
                f"{folder} was trained with --obs {args.obs} --action {args.action}, not on vectors with OSC"
            )
        # It is never stepped, so it needs no memory for contacts.
        env = ppo.make_env(args, scenes=None, impl="jax", budget=Budget(contacts=1, rows=1, pairs=1, candidates=1))
        learnt = ppo.load_policy(folder, ppo.acting(env, args.action))
        mean = jax.jit(lambda obs: ppo.mean_of(learnt.networks, learnt.normalizer(ppo.packed(obs))))

        def act(obs: np.ndarray) -> np.ndarray:
            action = np.asarray(mean(obs), np.float64)
            return ppo.upright(action) if args.action == "position" else action

        return _Learnt(env, act, args.action_repeat)
