"""What a policy has to offer to be served, and how one is found by name.

A policy comes in, as ``"module:Name"`` or as an object; ``Served`` goes out, which answers batches of observations with
chunks of actions whichever of the two methods the policy has.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from vecenv.errors import InvalidInput
from vecenv_eval.policies import raised

# What the protocol delivers for one slot: arrays and texts by the protocol's own names, without a batch axis.
Observation: TypeAlias = Mapping[str, Any]
# One action [7], or a chunk of them [K, 7].
Actions: TypeAlias = np.ndarray | Sequence[float] | Sequence[Sequence[float]]


class ServedPolicyError(InvalidInput):
    """A policy that cannot be served: it is not there, or it lacks a method, or its answers do not fit."""


@runtime_checkable
class ServedPolicy(Protocol):
    """A policy that answers many observations at once.

    Instead of ``act_batch`` a policy may have openpi's ``infer(observation) -> {"actions": ...}``, one observation at a
    time. Optional in both cases: ``reset()``, called when a client begins an episode, and ``metadata``, a mapping that
    openpi's clients get when they connect. Calls come from one thread.
    """

    def act_batch(self, observations: Sequence[Observation]) -> Sequence[Actions]:
        """Actions for each observation, [7] or [K, 7], in the units and the gripper convention of the protocol."""
        ...


@runtime_checkable
class InferPolicy(Protocol):
    """A policy that answers one observation at a time, as openpi's do."""

    def infer(self, observation: Observation) -> Mapping[str, Any]:
        """A mapping with ``actions``, [7] or [K, 7]."""
        ...


@dataclass(frozen=True)
class Served:
    """A policy behind one method.

    Attributes:
        policy: the policy.
    """

    policy: ServedPolicy | InferPolicy

    def __post_init__(self) -> None:
        if not isinstance(self.policy, ServedPolicy | InferPolicy):
            name = type(self.policy).__name__
            raise ServedPolicyError(f"{name} cannot be served: it needs act_batch(observations) or infer(observation)")

    @property
    def metadata(self) -> Mapping[str, Any]:
        """What the policy says about itself."""
        return getattr(self.policy, "metadata", {})

    def reset(self) -> None:
        """A client begins an episode."""
        if callable(reset := getattr(self.policy, "reset", None)):
            reset()

    def act(self, observations: Sequence[Observation]) -> list[np.ndarray]:
        """Chunks of actions [K, 7], one for each observation.

        Raises:
            ServedPolicyError: the policy answered something else.
        """
        if isinstance(self.policy, ServedPolicy):
            answers = list(self.policy.act_batch(observations))
        else:
            answers = [self.policy.infer(observation)["actions"] for observation in observations]
        if len(answers) != len(observations):
            raise ServedPolicyError(f"the policy answered {len(answers)} of {len(observations)} observations")
        return [_chunk(answer) for answer in answers]


def load(name: str) -> Served:
    """The policy called ``"module:Name"``: a class or function is called without arguments, an object taken as it is.

    Raises:
        ServedPolicyError: there is none, or it cannot be served.
    """
    module_name, _, attribute = name.partition(":")
    if not (module_name and attribute):
        raise ServedPolicyError(f"policy {name!r}: write module:Name")
    try:
        found: Any = getattr(importlib.import_module(module_name), attribute)
    except (Exception, SystemExit) as error:  # whatever a module raises
        raise ServedPolicyError(f"policy {name!r}: {raised(error)}") from error
    is_policy = not isinstance(found, type) and isinstance(found, ServedPolicy | InferPolicy)
    try:
        policy: Any = found if is_policy or not callable(found) else found()
    except (Exception, SystemExit) as error:  # whatever a policy's constructor raises
        raise ServedPolicyError(f"policy {name!r}: making it failed: {raised(error)}") from error
    return Served(policy)


def _chunk(answer: Actions) -> np.ndarray:
    chunk = np.atleast_2d(np.asarray(answer))
    if chunk.ndim != 2 or chunk.dtype.kind not in "biuf":
        raise ServedPolicyError(f"the policy answered {chunk.dtype} of shape {chunk.shape}; expected numbers, [K, 7]")
    return chunk
