"""What a policy server does wrong, as one exception: the harness counts it as an error, never as a failed episode."""

from __future__ import annotations

from vecenv.errors import ServiceError


class PolicyServerError(ServiceError):
    """A policy server cannot be reached, does not answer in time, reports an error, or answers something unusable.

    Args:
        server: protocol and address, e.g. ``"openpi at 127.0.0.1:8000"``.
        cause: what happened, in one sentence.
    """

    def __init__(self, server: str, cause: str) -> None:
        super().__init__(f"policy server {server}: {' '.join(cause.split())}")


def last_line(text: str) -> str:
    """The last line of a traceback, which says what was wrong; the whole text where it has one line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "no text"
