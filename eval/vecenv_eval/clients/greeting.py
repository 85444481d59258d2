"""Policies behind a websocket server whose first message is its metadata, packed as openpi packs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from vecenv_eval.clients.base import RemotePolicy
from vecenv_eval.clients.codecs import numpy_msgpack
from vecenv_eval.clients.config import ServerConfig
from vecenv_eval.clients.pool import LinkPool
from vecenv_eval.clients.websocket import Exchange, WebSocketLink

_Config = TypeVar("_Config", bound=ServerConfig)


class GreetedPolicy(RemotePolicy[_Config]):
    """A policy behind such a server, over ``config.connections`` connections; subclasses send the requests.

    Args:
        config: where the server is, and the options of the protocol.

    Attributes:
        metadata: what the server said about itself when it was last connected to.
    """

    def __init__(self, config: _Config) -> None:
        super().__init__(config)
        self.metadata: Mapping[str, Any] = {}
        links = [WebSocketLink(config, self.server, self._greet) for _ in range(config.connections)]
        self._links = LinkPool(links)

    def close(self) -> None:
        """Close the connections; the next call opens them again."""
        self._links.close()

    def _greet(self, exchange: Exchange) -> None:
        self.metadata = numpy_msgpack.unpack(exchange.receive())
