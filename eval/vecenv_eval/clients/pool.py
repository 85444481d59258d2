"""Connections that carry any request: each is used by one request at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from queue import SimpleQueue
from typing import Generic, Protocol, TypeVar


class Closable(Protocol):
    """A connection."""

    def close(self) -> None:
        """Close it; it may be opened again."""
        ...


_Link = TypeVar("_Link", bound=Closable)


class LinkPool(Generic[_Link]):
    """A fixed number of connections, lent out one by one.

    Args:
        links: the connections.
    """

    def __init__(self, links: list[_Link]) -> None:
        self._links = links
        self._free: SimpleQueue[_Link] = SimpleQueue()
        for link in links:
            self._free.put(link)

    @contextmanager
    def borrowed(self) -> Iterator[_Link]:
        """A connection that nobody else uses meanwhile; waits until one is free."""
        link = self._free.get()
        try:
            yield link
        finally:
            self._free.put(link)

    def close(self) -> None:
        """Close all connections."""
        for link in self._links:
            link.close()
