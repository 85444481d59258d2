"""What an evaluation ran under, so that two success rates can be told apart: protocol, horizon, start, contacts, ...

An environment comes in; a plain mapping for ``config.json`` and ``summary.json`` goes out, and from it the sentence
that reports and tables carry.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vecenv import family, protocols
from vecenv_eval.config import STORE_CHOICES
from vecenv_eval.store import StoreError

if TYPE_CHECKING:
    from vecenv.contract import BatchEnv
    from vecenv_eval.config import EvalConfig

# Stands for a choice that a family of suites does not have.
NONE = "-"
# Conditions that no verdict depends on.
INDIFFERENT = ("shard", "store")
# What `describe` reads.
_EVERY = frozenset(
    {"protocol", "instead", "horizon", "idle_steps", "start", "contacts", "colors", "fixtures", "seed", "success"}
)


def conditions(env: BatchEnv, config: EvalConfig) -> dict[str, Any]:
    """What episodes in an environment run under.

    Args:
        env: the environment, whose own configuration is what counts.
        config: what was asked for, for environments without a configuration.

    Returns:
        Plain types: ``protocol``; ``instead``, options that are not the protocol's, name -> [the protocol's, the one in
        use]; ``horizon`` in ticks, ``idle_steps``, ``start``, ``contacts``, ``colors``, ``fixtures``, ``reset_loop``
        (of upstream's fixtures), ``seed`` and ``success``; and ``deterministic``, True, where that was asked for.
        ``"-"`` stands where the suite has no such choice.
    """
    chosen = protocols.protocol(config.protocol, family(config.suite))
    options = {name: getattr(getattr(env, "config", None), name, None) for name in chosen.options(config.suite)}
    used = chosen.options(config.suite) | {name: value for name, value in options.items() if value is not None}
    if chosen.family == protocols.SIMPLER:
        return _simpler(env, chosen, used)
    upstream = used["fixtures"] == "upstream"
    instead = chosen.departures(config.suite, used)
    return {
        "protocol": chosen.name,
        "instead": {name: [_plain(value) for value in pair] for name, pair in instead.items()},
        "horizon": used["max_steps"],
        "idle_steps": used["settle_steps"] if used["start"] == "raw" else 0,
        "start": used["start"],
        "contacts": _of(env, "contacts"),
        "colors": _of(env, "render", "colors"),
        "fixtures": _plain(used["fixtures"]),
        "reset_loop": asdict(protocols.reset_loop(used["reset_loop"])) if upstream else NONE,
        "seed": used["seed"],
        "success": used["success"],
        **({"deterministic": True} if _of(env, "deterministic") is True else {}),
    }


def stored_as(config: EvalConfig, store: str) -> dict[str, Any]:
    """Conditions that no verdict depends on: which shard of the episodes this is, and how a database is kept.

    Args:
        config: what was asked for.
        store: ``Rows.describe()``.
    """
    shard = {} if config.shard is None else {"shard": config.shard}
    return shard if config.store == STORE_CHOICES[0] else {**shard, "store": store}


def _simpler(env: BatchEnv, chosen: protocols.Protocol, used: Mapping[str, Any]) -> dict[str, Any]:
    most = _of(env, "max_steps")
    return {
        "protocol": chosen.name,
        "instead": {} if used["success"] == chosen.success else {"success": [chosen.success, used["success"]]},
        "horizon": "each task's own" if most in (None, NONE) else most,
        **dict.fromkeys(("idle_steps", "start", "contacts", "colors", "fixtures", "reset_loop"), NONE),
        "seed": "2022 to 2071" if chosen.name == protocols.DEFAULT else "the published lists'",
        "success": used["success"],
    }


def checked_content(content: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    """The content of ``config.json``, in which everything but the settings has the form that readers expect.

    Raises:
        StoreError: something has not; the message names the file and the key.
    """
    runs, conditions, name = content.get("runs", []), content.get("conditions", {}), content.get("policy_name", "")
    if not isinstance(runs, list) or not all(isinstance(run, dict) for run in runs):
        raise StoreError(f"{path}: runs is no list of JSON objects")
    if not isinstance(name, str):
        raise StoreError(f"{path}: policy_name is {name!r:.50}, not text")
    if not isinstance(conditions, dict):
        raise StoreError(f"{path}: conditions is {conditions!r:.50}, not a JSON object")
    if not conditions:
        return content
    if missing := sorted(_EVERY - conditions.keys()):
        raise StoreError(f"{path}: conditions has no {', '.join(missing)}")
    instead = conditions["instead"]
    pairs = isinstance(instead, dict) and all(isinstance(pair, list) and len(pair) == 2 for pair in instead.values())
    if not pairs:
        raise StoreError(f"{path}: conditions: instead is {instead!r:.50}, not pairs by name")
    for key, value in conditions.items():
        if key != "instead" and not isinstance(value, str | int | float | bool | dict | None):
            raise StoreError(f"{path}: conditions: {key} is {value!r:.50}, not a number or text")
    if not isinstance(conditions["protocol"], str):
        raise StoreError(f"{path}: conditions: protocol is {conditions['protocol']!r:.50}, not text")
    return content


def describe(conditions: Mapping[str, Any]) -> str:
    """The conditions in a sentence; "" for none."""
    if not conditions:
        return ""
    instead = [f"{name} {ours} -> {used}" for name, (ours, used) in conditions["instead"].items()]
    idle = f" and {conditions['idle_steps']} idle ticks" if conditions["idle_steps"] not in (0, NONE) else ""
    parts = {
        "protocol": conditions["protocol"] + (f" (but {', '.join(instead)})" if instead else ""),
        "horizon": conditions["horizon"],
        "success": conditions["success"],
        "start": f"{conditions['start']}{idle}",
        "contacts": conditions["contacts"],
        "colours": conditions["colors"],
        "fixtures": conditions["fixtures"],
        "seed": conditions["seed"],
    }
    parts |= {"deterministic": "yes"} if conditions.get("deterministic") else {}
    parts |= {name: conditions[name] for name in INDIFFERENT if name in conditions}
    return "; ".join(f"{name} {value}" for name, value in parts.items()) + "."


def _of(env: BatchEnv, *path: str) -> Any:
    """An attribute of an environment's configuration; ``"-"`` where it has no such choice."""
    value: Any = getattr(env, "config", None)
    for name in path:
        value = getattr(value, name, NONE)
    return value


def _plain(value: object) -> object:
    """An option as JSON and a reader see it."""
    if isinstance(value, protocols.ResetLoop):
        return asdict(value)
    return f"given for {', '.join(sorted(value))}" if isinstance(value, Mapping) else value
