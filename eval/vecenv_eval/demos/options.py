"""The options of ``vecenv.make`` that a recording holds, so that a replay repeats the recorded episode."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from typing import Any

import vecenv
from vecenv import protocols
from vecenv.contract import BatchEnv
from vecenv.util.configs import field_names
from vecenv_eval.demos.hdf5 import DemoError

MAX_SETTLE_STEPS = 1_000
# The options of ``vecenv.make`` that decide where an episode begins and how it goes; no path is among them.
_OPTIONS = frozenset(
    {
        *("backend", "geometry", "contacts", "deterministic", "fixtures", "reset_loop", "start", "settle_steps"),
        *("max_steps", "success", "seed"),
    }
)
_SIMPLER_OPTIONS = frozenset({"backend", "gripper", "max_steps", "success", "variant", "protocol"})
# Types of those whose default does not show it.
_KINDS = {
    "variant": (dict,),
    "fixtures": (str, dict),
    "reset_loop": (dict,),
    "start": (str,),
    "settle_steps": (int,),
    "max_steps": (int,),
    "success": (str,),
    "seed": (int,),
}


def make_options(make: Callable[..., BatchEnv], **arguments: Any) -> dict[str, Any]:
    """The options under which ``make(**arguments)`` runs episodes, those of the protocol and defaults included.

    SIMPLER's executed actions are in the robot's own convention of the gripper, whatever the policy's was.
    """
    if make is vecenv.make and vecenv.family(arguments.get("suite", "")) == protocols.SIMPLER:
        return _simpler_options(**arguments)
    known = _defaults(make)
    given = {name: value for name, value in {**known, **arguments}.items() if value is not None}
    chosen = protocols.protocol(given.get("protocol", protocols.DEFAULT))
    options = {**chosen.options(given.get("suite", "")), **given}
    options["reset_loop"] = asdict(protocols.reset_loop(options["reset_loop"]))
    if options["fixtures"] != "upstream":
        del options["reset_loop"]
    return {name: value for name, value in options.items() if name in _OPTIONS & known.keys()}


def _simpler_options(suite: str, **arguments: Any) -> dict[str, Any]:
    config = vecenv.make_config(suite, arguments)
    assert isinstance(config, vecenv.SimplerConfig)
    values = {name: getattr(config, name) for name in _SIMPLER_OPTIONS}
    if config.variant is not None:
        values["variant"] = {name: value for name, value in vars(config.variant).items() if value is not None}
    values |= {"gripper": "native", "success": config.success_mode}
    return {name: value for name, value in sorted(values.items()) if value is not None}


def _defaults(make: Callable[..., BatchEnv]) -> dict[str, Any]:
    """Options of ``make`` with their defaults: its own, and of ``vecenv.make`` the fields of ``LiberoConfig``."""
    parameters = inspect.signature(make).parameters.values()
    found = {each.name: each.default for each in parameters if each.default is not each.empty}
    if make is vecenv.make:
        found |= {each.name: each.default for each in fields(vecenv.LiberoConfig)}
    return found


def check_options(options: Mapping[str, Any], suite: str) -> None:
    """Check names and types of options read from a file; their values are checked by ``vecenv.make``.

    Args:
        options: what the file says.
        suite: what it demonstrates.

    Raises:
        DemoError: an option is not among those that a recording holds, or has the wrong type.
    """
    if vecenv.family(suite) == protocols.SIMPLER:
        kind, names = vecenv.SimplerConfig, _SIMPLER_OPTIONS
    else:
        kind, names = vecenv.LiberoConfig, _OPTIONS
    known = names & set(field_names(kind))
    defaults = {each.name: each.default for each in fields(kind)}
    for option, value in options.items():
        if option not in known:
            raise DemoError(f"attribute make: {option!r:.50} is none of {', '.join(sorted(known))}")
        _check_option(option, value, defaults[option])


def _check_option(name: str, value: object, default: object) -> None:
    kinds = _KINDS.get(name, (type(default),))
    if type(value) not in kinds:
        raise DemoError(f"attribute make: {name}={value!r:.50}: expected {kinds[-1].__name__}")
    if name == "settle_steps" and isinstance(value, int) and value > MAX_SETTLE_STEPS:
        raise DemoError(f"attribute make: settle_steps={value}: more than {MAX_SETTLE_STEPS:,}")
