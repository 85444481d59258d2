"""The options of ``vecenv.make`` that a recording holds, so that a replay repeats the recorded episode."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from typing import Any

import vecenv
from vecenv import protocols
from vecenv.contract import BatchEnv
from vecenv_eval.demos.hdf5 import DemoError

MAX_SETTLE_STEPS = 1_000
# The options of ``vecenv.make`` that decide where an episode begins and how it goes; no path is among them.
_OPTIONS = frozenset(
    {
        *("backend", "geometry", "contacts", "fixtures", "reset_loop", "start", "settle_steps", "max_steps"),
        *("success", "seed"),
    }
)
# Types of those whose default does not show it.
_KINDS = {
    "fixtures": (str, dict),
    "reset_loop": (dict,),
    "start": (str,),
    "settle_steps": (int,),
    "max_steps": (int,),
    "success": (str,),
    "seed": (int,),
}


def make_options(make: Callable[..., BatchEnv], **arguments: Any) -> dict[str, Any]:
    """The options under which ``make(**arguments)`` runs episodes, those of the protocol and defaults included."""
    known = _defaults(make)
    given = {name: value for name, value in {**known, **arguments}.items() if value is not None}
    chosen = protocols.protocol(given.get("protocol", protocols.DEFAULT))
    options = {**chosen.options(given.get("suite", "")), **given}
    options["reset_loop"] = asdict(protocols.reset_loop(options["reset_loop"]))
    if options["fixtures"] != "upstream":
        del options["reset_loop"]
    return {name: value for name, value in options.items() if name in _OPTIONS & known.keys()}


def _defaults(make: Callable[..., BatchEnv]) -> dict[str, Any]:
    """Options of ``make`` with their defaults: its own, and of ``vecenv.make`` the fields of ``LiberoConfig``."""
    parameters = inspect.signature(make).parameters.values()
    found = {each.name: each.default for each in parameters if each.default is not each.empty}
    if make is vecenv.make:
        found |= {each.name: each.default for each in fields(vecenv.LiberoConfig)}
    return found


def check_options(options: Mapping[str, Any]) -> None:
    """Check names and types of options read from a file; their values are checked by ``vecenv.make``.

    Raises:
        DemoError: an option is not among those that a recording holds, or has the wrong type.
    """
    defaults = _defaults(vecenv.make)
    known = defaults.keys() & _OPTIONS
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
