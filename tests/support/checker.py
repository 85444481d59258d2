"""The run-time type checker of the signatures that carry array shapes; ``tests/conftest.py`` installs it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

# An int is good enough where a float is asked for, as for every static checker.
_CONF = BeartypeConf(is_pep484_tower=True)


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its arguments and results checked."""
    return beartype(conf=_CONF)(function)
