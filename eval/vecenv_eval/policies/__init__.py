"""Policies: what the harness asks of one, and how a name becomes one.

A name comes in (``"zero"``, or ``"my_module:MyPolicy"`` for the user's own), a :class:`Policy` goes out. A policy acts
for the whole batch at once and sees the environment through its public verbs only.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import traceback
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol, TypeGuard, get_type_hints, runtime_checkable

import numpy as np

from vecenv.contract import BatchEnv, Control, ResetInfo
from vecenv.errors import InvalidInput, ServiceError

BUILTIN = {
    "gr00t": "vecenv_eval.clients.gr00t:Gr00tPolicy",
    "openpi": "vecenv_eval.clients.openpi:OpenPiPolicy",
    "pick_place": "vecenv_eval.policies.pick_place.policy:PickPlacePolicy",
    "random": "vecenv_eval.policies.random:RandomPolicy",
    "simpler_scripted": "vecenv_eval.policies.simpler.policy:SimplerScriptedPolicy",
    "starvla": "vecenv_eval.clients.starvla:StarVLAPolicy",
    "vla-eval": "vecenv_eval.clients.vla_eval:VlaEvalPolicy",
    "voxposer": "vecenv_eval.policies.voxposer:VoxPoserPolicy",
    "zero": "vecenv_eval.policies.scripted:ZeroPolicy",
}
_NO_POLICY = "is not a policy: it needs a name, reset(env, info) and act(env)"


class PolicyError(InvalidInput):
    """A policy cannot be made: unknown name, a module that does not import, or arguments it does not take."""


class PolicyUnavailable(ServiceError):
    """A policy can act in no episode of the run, whatever is tried: the run ends at once.

    Its ``act`` raises this, for a key that is wrong or a model that does not exist. The episodes that were running end
    in an error with the message, and no other begins.
    """


@runtime_checkable
class Policy(Protocol):
    """What the harness asks of a policy.

    Attributes:
        name: how the policy is called in results.
    """

    name: str

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        """Begin with a freshly placed batch; called once after each ``env.reset()``."""
        ...

    def act(self, env: BatchEnv) -> np.ndarray | Control:
        """Decide what every slot does next.

        Returns:
            Actions for ``step_continuous``, [B, 7] or a chunk [B, K, 7] (rows of finished slots are ignored); or, from
            a policy that stepped the environment itself (with ``step_ee_pose``, for example), the ``Control`` it got.
        """
        ...


@runtime_checkable
class Seeing(Protocol):
    """A policy that says whose images it reads, so that a run without them is refused before it begins; optional."""

    def needed_cameras(self) -> Sequence[str]:
        """Names of the cameras, by which it reads ``observe_egocentric().images``."""
        ...


@runtime_checkable
class Reporting(Protocol):
    """A policy that reports more about each episode than the verdict; optional."""

    def extras(self, slot: int) -> Mapping[str, Any]:
        """Numbers and words about the episode in a slot, which has just finished; they go into its record."""
        ...


@runtime_checkable
class Failing(Protocol):
    """A policy that may be unable to act in single episodes, while the others go on; optional.

    It ends such an episode with ``env.end_episodes``.
    """

    def episode_error(self, slot: int) -> str:
        """Why the episode in a slot, which has just finished, has no verdict; "" when it has one.

        The episode is recorded as an error with this cause, not as a failure, and runs again.
        """
        ...


@runtime_checkable
class Logging(Protocol):
    """A policy that keeps a log of each episode, which is stored with the results; optional."""

    def episode_log(self, slot: int) -> Sequence[Mapping[str, Any]]:
        """Objects for JSON about the episode in a slot so far; written to ``DIR/policy_logs``, one a line."""
        ...


@runtime_checkable
class Refillable(Protocol):
    """A policy whose slots may begin new episodes one by one; optional.

    With it, a slot whose episode has ended takes the next one at once. Without it, the harness waits until every slot
    has finished, and calls ``reset`` for the next batch.
    """

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        """Begin new episodes in some slots, while the others continue theirs.

        Args:
            env: the environment, in which the slots were just reset.
            info: what its reset returned, for all slots.
            slots: indices of the slots that begin, ascending.
        """
        ...


@runtime_checkable
class Closing(Protocol):
    """A policy that holds connections or files; optional."""

    def close(self) -> None:
        """Release them; called when the run ends, however it ends."""
        ...


@runtime_checkable
class Ending(Protocol):
    """A policy that learns how episodes end, to log or to learn; optional."""

    def episode_end(self, slot: int, record: Mapping[str, Any]) -> None:
        """An episode has ended: its slot, and its record (``vecenv_eval.store.Record``) as plain values."""
        ...


def extras_of(policy: Policy, slot: int) -> dict[str, Any]:
    """What a policy reports about the episode in a slot; nothing if it reports nothing."""
    return dict(policy.extras(slot)) if isinstance(policy, Reporting) else {}


def error_of(policy: Policy, slot: int) -> str:
    """Why the episode in a slot has no verdict; "" when it has one."""
    return policy.episode_error(slot) if isinstance(policy, Failing) else ""


def make_policy(name: str, given: Mapping[str, Any] | None = None, /, *, seed: int = 0, **arguments: Any) -> Policy:
    """Make the policy called ``name``.

    Args:
        name: one of ``BUILTIN``, or ``"module:Class"``: a class with the methods of a policy, a function whose return
            annotation is one, or a policy. Nothing else of a module is called.
        given: constructor arguments, a ``seed`` among them if the policy is to have one of its own.
        seed: passed on to policies whose constructor takes a ``seed`` (unless ``given`` already has one).
        **arguments: further constructor arguments.

    Raises:
        PolicyError: the name is unknown, its module does not import, it does not take the arguments, or it raises an
            exception.
    """
    factory = _bound(name, seed, {**(given or {}), **arguments})
    try:
        policy = factory()
    except PolicyError:
        raise
    except (Exception, SystemExit) as error:  # whatever a policy's constructor raises
        raise PolicyError(f"policy {name!r}: making it failed: {raised(error)}") from error
    try:
        fits = isinstance(policy, Policy)
        hasattr(policy, "needed_cameras")  # as the first of the optional methods to be asked for
    except Exception as error:  # whatever a property or __getattr__ raises
        raise PolicyError(f"policy {name!r}: reading its attributes failed: {raised(error)}") from error
    if not fits:
        raise PolicyError(f"policy {name!r} {_NO_POLICY}")
    return policy


def check_policy(name: str, arguments: Mapping[str, Any]) -> None:
    """Raise what ``make_policy`` raises before it makes the policy, which may be a large model."""
    _bound(name, 0, arguments)


def _bound(name: str, seed: int, arguments: Mapping[str, Any]) -> Callable[[], Any]:
    """What makes the policy, with its arguments."""
    factory = _load(name)
    parameters = inspect.signature(factory).parameters
    given = {"seed": seed, **arguments} if "seed" in parameters else dict(arguments)
    try:
        inspect.signature(factory).bind(**given)
    except TypeError as error:
        takes = ", ".join(parameters) or "none"
        raise PolicyError(f"policy {name!r}: {error}; arguments it takes: {takes}") from None
    return partial(factory, **given)


def _load(name: str) -> Callable[..., object]:
    """The class or function that makes the policy.

    Raises:
        PolicyError: there is none of this name, or it is something else.
    """
    target = BUILTIN.get(name, name)
    module_name, separator, attribute = target.partition(":")
    if not (separator and module_name and attribute):
        close = difflib.get_close_matches(name, BUILTIN, n=1) or sorted(BUILTIN)
        raise PolicyError(f"unknown policy {name!r}: did you mean {', '.join(close)}? Your own go by 'module:Class'")
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever a module raises, a script that ends with sys.exit() included
        raise PolicyError(f"policy {name!r}: importing {module_name!r} failed: {raised(error)}") from error
    found = getattr(module, attribute, None)
    if _makes_policies(found):
        return found
    if isinstance(found, Policy) and not isinstance(found, type):
        return lambda: found
    if not callable(found):
        raise PolicyError(f"policy {name!r}: the module {module_name!r} has no class {attribute!r}")
    raise PolicyError(f"policy {name!r} {_NO_POLICY}")


def _makes_policies(found: object) -> TypeGuard[Callable[..., object]]:
    """Whether this is a class of policies, or a function that says that it returns one; nothing else is called."""
    if inspect.isfunction(found):
        try:
            found = get_type_hints(found).get("return")
        except Exception:  # whatever an annotation raises
            return False
    return isinstance(found, type) and all(callable(getattr(found, verb, None)) for verb in ("reset", "act"))


def in_words(error: BaseException) -> str:
    """An exception's type and message; the type alone where making the message raises another exception."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:
        return type(error).__name__


def raised(error: BaseException) -> str:
    """An exception in a sentence: its type, its message, and the file and line that raised it."""
    text = " ".join(in_words(error).rstrip(": ").split())
    frames = traceback.extract_tb(error.__traceback__)
    own = [
        frame for frame in frames if not frame.filename.startswith("<frozen") and frame.filename != importlib.__file__
    ]
    # Of an error in this file, such as a module that is not there, the line says nothing to the user.
    return f"{text} ({own[-1].filename}:{own[-1].lineno})" if own and own[-1].filename != __file__ else text
