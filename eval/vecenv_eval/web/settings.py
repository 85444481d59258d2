"""How a server is run: where it listens, what it asks of clients, and its limits."""

from __future__ import annotations

import ipaddress
import os
import secrets
from dataclasses import dataclass
from pathlib import Path

from vecenv.errors import InvalidInput

# Environment variable with the token.
TOKEN_VARIABLE = "VECENV_TOKEN"
# Shortest token that is taken, characters.
SHORTEST_TOKEN = 16
_LOOPBACK_NAMES = frozenset({"localhost", "ip6-localhost"})


class ServeError(InvalidInput):
    """An option of the server cannot be used."""


@dataclass(frozen=True, kw_only=True)
class ServeSettings:
    """Options of the application.

    Attributes:
        host: address it listens on.
        token: what clients have to show; None asks nothing, and is refused for an address other than loopback.
        allowed_hosts: names beside the address itself by which clients may call the server (``Host`` header).
        allowed_origins: origins beside the server's own from which pages may call it: ``"http://other:8000"``.
        trust_clients: clients may name ``module:Class`` policies, policies behind servers, and options that name files,
            addresses or language models. The command line may always.
        max_slots: most slots of a session that a client builds.
        max_streams: most WebSockets at once.
        max_connections: most connections at once.
        max_body: largest body of a request, bytes.
        max_node_body: the same for nodes, whose inputs may be images.
        max_depth: deepest nesting of a JSON body.
        max_message: largest message of a WebSocket client, bytes.
        messages_per_second: messages a second that a WebSocket client may send, on average.
        requests_per_second: requests a second of one address, on average; ten times as many at once.
        logins_per_minute: wrong tokens a minute of one address.
        writer_timeout_s: seconds of silence after which the writer loses the session.
        send_timeout_s: seconds that a reader may take for one message before it is disconnected.
        nodes: serve the node sets.
    """

    host: str = "127.0.0.1"
    token: str | None = None
    allowed_hosts: tuple[str, ...] = ()
    allowed_origins: tuple[str, ...] = ()
    trust_clients: bool = False
    max_slots: int = 64
    max_streams: int = 256
    max_connections: int = 512
    max_body: int = 256 * 1024
    max_node_body: int = 8 * 1024 * 1024
    max_depth: int = 32
    max_message: int = 4096
    messages_per_second: float = 20.0
    requests_per_second: float = 50.0
    logins_per_minute: float = 10.0
    writer_timeout_s: float = 60.0
    send_timeout_s: float = 20.0
    nodes: bool = True

    def __post_init__(self) -> None:
        if self.token is not None and len(self.token) < SHORTEST_TOKEN:
            raise ServeError(f"the token has {len(self.token)} characters: at least {SHORTEST_TOKEN} are needed")
        if self.token is None and not is_loopback(self.host):
            raise ServeError(f"--host {self.host} is reachable from other machines: a token is needed")


def is_loopback(host: str) -> bool:
    """Whether an address or name is this machine's own, unreachable from others."""
    name = host.strip("[]").rstrip(".").lower()
    if name in _LOOPBACK_NAMES or name.endswith(".localhost"):
        return True
    address = address_of(name)
    return address is not None and address.is_loopback


def address_of(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The IP address that a name spells, None for any other name."""
    try:
        return ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return None


def read_token(file: Path | None) -> str | None:
    """The token of a file, else of the environment variable ``VECENV_TOKEN``; None where neither is given.

    Raises:
        ServeError: the file cannot be read, or is empty.
    """
    if file is None:
        return os.environ.get(TOKEN_VARIABLE, "").strip() or None
    try:
        token = file.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ServeError(f"--token-file {file} cannot be read: {error}") from None
    if not token:
        raise ServeError(f"--token-file {file} is empty")
    return token


def new_token() -> str:
    """A random token, 43 characters."""
    return secrets.token_urlsafe(32)
