"""What the library reports while it works (``logging``, level INFO), shown where a command runs.

Loggers are named after their modules, below ``vecenv``. Without a handler Python shows warnings only.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

ROOT = "vecenv"


class Saying(logging.Handler):
    """Gives the text of every record to a function.

    Args:
        say: the function.
    """

    def __init__(self, say: Callable[[str], object]) -> None:
        super().__init__(logging.INFO)
        self._say = say

    def emit(self, record: logging.LogRecord) -> None:
        """Hand a record on."""
        try:
            self._say(self.format(record))
        except Exception:  # nothing that only reports may end what it reports on
            self.handleError(record)


def to_stderr(text: str) -> None:
    """Print a line to what standard error is now: a progress bar may have replaced it."""
    print(text, file=sys.stderr, flush=True)


@contextmanager
def reported(say: Callable[[str], object] = to_stderr) -> Iterator[None]:
    """Within the context, every report of vecenv goes to a function, standard error by default, and nowhere else.

    Packages that configure Python's root logger would print it a second time.
    """
    logger, handler = logging.getLogger(ROOT), Saying(say)
    before, propagates = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.propagate = propagates
        logger.removeHandler(handler)
