"""What an error does to the slot that it happened in: it is stopped, with the cause in words, and no other slot is."""

from __future__ import annotations

import logging

from vecenv.errors import VecenvError
from voxposer.language.replies import LlmError
from voxposer.sandbox.guard import HostFault, shortened
from voxposer.slots import Slot
from voxposer.turns import TurnsOver

# Characters of the cause of a slot that is stopped.
_CAUSE = 2000
# Errors of a program, of what it asked for, or of what it looked for: they stop a slot. So does any other, which is
# logged as well, because this package is then to blame.
_EXPECTED = (HostFault, VecenvError)
_log = logging.getLogger(__name__)


def stop_with(slot: Slot, error: Exception) -> None:
    """Stop a slot, and no other, for an error in its program or in planning what that asked for."""
    if not isinstance(error, _EXPECTED):
        _log.error("a slot was stopped by an unexpected error", exc_info=error)
    slot.interface.taken()  # what its programs asked for so far is never planned
    if slot.cause:
        return
    slot.stop(f"{slot.missing} ({_described(error)})" if slot.missing else _described(error))


def end_with(slot: Slot, error: Exception) -> None:
    """Stop a slot whose program failed; without a verdict if the model was not asked. What ends the run is raised."""
    if isinstance(error, TurnsOver) or (isinstance(error, LlmError) and error.permanent):
        raise error
    if isinstance(error, LlmError):
        slot.give_up(_described(error))
    else:
        stop_with(slot, error)


def _described(error: Exception) -> str:
    return shortened(f"{type(error).__name__}: {error}", _CAUSE)
