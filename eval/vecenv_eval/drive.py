"""The loop of an episode batch: a policy acts on an environment until every slot has finished."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from vecenv.contract import ACTION_DIM, BatchEnv, Control
from vecenv.errors import VecenvError
from vecenv_eval.policies import Policy

# Calls of a policy in a row that may leave every live slot where it was, before it counts as stuck.
MAX_IDLE_CALLS = 100


class PolicyStuck(VecenvError, RuntimeError):
    """The policy keeps returning without a step being taken in any live slot."""


def drive(
    env: BatchEnv, policy: Policy, refill: Callable[[np.ndarray], np.ndarray] | None = None
) -> Iterator[tuple[Control, np.ndarray]]:
    """Let a policy act on a batch that was just reset, until every slot has finished.

    A slot may be done already, because its physics failed in the reset. It is reported before the policy is asked, so
    that the policy is not asked for a batch of which nothing can be seen.

    Args:
        env: the environment.
        policy: the policy, which was reset for it.
        refill: called after each control with the slots that have finished, bool [B]; begins new episodes in some of
            them and returns their indices.

    Yields:
        Each control as it comes, and which slots it finished, bool [B].

    Raises:
        PolicyStuck: 100 calls of ``act`` in a row took no step in any live slot.
    """
    done = np.zeros(env.num_envs, bool)
    steps = np.zeros(env.num_envs, int)
    idle = 0
    while not done.all():
        ended_in_reset = (env.done & ~done).any()
        decision = np.zeros((env.num_envs, 0, ACTION_DIM)) if ended_in_reset else policy.act(env)
        control = decision if isinstance(decision, Control) else env.step_continuous(decision)
        finished = control.done & ~done
        moved = finished.any() or (control.step_index[~done] > steps[~done]).any()
        idle = 0 if moved else idle + 1
        if idle >= MAX_IDLE_CALLS:
            raise PolicyStuck(f"policy {policy.name!r}: {idle} calls of act() in a row took no step in any live slot")
        done, steps = done | finished, control.step_index.copy()
        yield control, finished
        if refill is not None and done.any():
            begun = refill(done)
            done[begun], steps[begun] = False, 0
