"""The run-time type checker of the signatures that carry array shapes; ``tests/conftest.py`` installs it."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

# An int is good enough where a float is asked for, as for every static checker.
check = beartype(conf=BeartypeConf(is_pep484_tower=True))
