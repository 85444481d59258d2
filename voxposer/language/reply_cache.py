"""Replies of language models on disk, found by a hash of the whole request.

One SQLite file, ``replies.sqlite3`` in the folder ``llm`` of vecenv's cache (``VECENV_CACHE_DIR`` names another place,
and an empty value turns the cache off). Values are JSON. Any number of processes may share the file, and it may be
deleted at any time.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path

from vecenv.util import caching
from voxposer.language.replies import Reply

# Seconds another process may hold the file.
_BUSY_S = 30.0


def cache_at(wanted: bool | Path) -> ReplyCache | None:
    """The cache in a folder, in the default folder for True, none for False or when caches are turned off."""
    where = wanted if isinstance(wanted, Path) else caching.folder("llm") if wanted else None
    return None if where is None else ReplyCache(where)


class ReplyCache:
    """Replies on disk by the hash of their requests; a file that cannot be used is a warning, not an error."""

    def __init__(self, where: Path) -> None:
        """A cache in a folder, which is created at the first use."""
        self.path = where / "replies.sqlite3"

    def get(self, key: str) -> Reply | None:
        """The reply to a request, None if there is none or it is damaged."""
        if not self.path.exists():
            return None
        with self._warning(), self._open() as connection:
            row = connection.execute("SELECT reply FROM replies WHERE key = ?", (key,)).fetchone()
            return None if row is None else _decoded(row[0])
        return None

    def put(self, key: str, request: Mapping[str, object], reply: Reply) -> None:
        """Keep a reply; one that is there already stays, so that all processes agree."""
        with self._warning():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self._open() as connection:
                row = (key, json.dumps(request, sort_keys=True), json.dumps(asdict(reply)))
                connection.execute("INSERT OR IGNORE INTO replies VALUES (?, ?, ?)", row)

    @contextlib.contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        """A connection of this thread and process alone; what is done in it is stored whole or not at all."""
        with contextlib.closing(sqlite3.connect(self.path, timeout=_BUSY_S)) as connection, connection:
            connection.execute("CREATE TABLE IF NOT EXISTS replies (key TEXT PRIMARY KEY, request TEXT, reply TEXT)")
            yield connection

    @contextlib.contextmanager
    def _warning(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            message = f"{self.path}: replies of language models are not kept ({error}); if it is damaged, delete it"
            warnings.warn(message, stacklevel=4)


def _decoded(text: str) -> Reply | None:
    try:
        reply = Reply(**json.loads(text))
    except (ValueError, TypeError):
        return None
    numbers = (reply.prompt_tokens or 0, reply.completion_tokens or 0, reply.cost_usd or 0.0)
    words = (reply.text, reply.model, reply.finish_reason)
    sound = all(isinstance(word, str) for word in words) and all(isinstance(number, (int, float)) for number in numbers)
    return reply if sound and reply.text else None
