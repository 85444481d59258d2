"""What the routes of one application share: the session, its writers, tokens, and the readers that are connected."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from vecenv_eval.panel.session import Session
from vecenv_eval.web.limits import Buckets
from vecenv_eval.web.security import Tokens
from vecenv_eval.web.settings import ServeSettings
from vecenv_eval.web.writer import Writers

SESSION = "session"


class Context:
    """Shared by the routes.

    Args:
        session: what is driven, None for none.
        settings: security and limits.

    Attributes:
        writers: who may change what.
        tokens: compares tokens.
        failures: counts wrong tokens by address.
        streams: WebSockets that are open.
        closing: set when the server stops, so that streams end.
        url_3d: address of the 3-D view, once there is one.
    """

    def __init__(self, session: Session | None, settings: ServeSettings) -> None:
        self.session, self.settings = session, settings
        self.writers = Writers(settings.writer_timeout_s)
        self.tokens = Tokens(settings.token)
        self.failures = Buckets(settings.logins_per_minute / 60, settings.logins_per_minute)
        self.streams = 0
        self.closing = asyncio.Event()
        self.url_3d: str | None = None
        self._closers: list[Callable[[], object]] = []

    def shut(self) -> None:
        """The server is about to stop: the run ends, and nobody waits for it."""
        if self.session is not None:
            self.session.shut()

    def on_close(self, closer: Callable[[], object]) -> None:
        """Call a function when the server stops."""
        self._closers.append(closer)

    async def close(self) -> None:
        """Let go of what the routes have made; the session belongs to who made it."""
        self.closing.set()
        for closer in self._closers:
            await asyncio.to_thread(closer)
