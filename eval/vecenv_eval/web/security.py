"""Who may speak to the server: the address it was called by, the page that calls, and the token.

``Guard`` wraps the whole application, WebSockets included, and refuses what it does not know before anything else runs:

* ``Host`` must name this server. A page of another site whose name was made to resolve to this address (DNS rebinding)
  calls with its own name and gets nothing.
* ``Origin``, which browsers send with whatever a page asks for, must be the server itself or one that was allowed.
* With a token, everything but the page and ``/api/health`` needs it: in ``Authorization: Bearer``, or as the cookie
  that ``POST /api/login`` sets. The cookie holds a secret of this process that was derived from the token, because
  browsers send cookies to every port of a host. A token in an address is not looked at.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import socket
from collections.abc import Mapping
from http.cookies import CookieError, SimpleCookie
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vecenv_eval.web.limits import Buckets, Refusal, client_of, refuse
from vecenv_eval.web.settings import ServeSettings, address_of, is_loopback

COOKIE = "vecenv_token"
# Answered without a token: the page itself, which holds no data, and what it needs to ask for the token.
_OPEN = frozenset({"/", "/view", "/api/health", "/api/login", "/favicon.ico"})
_OPEN_FOLDER = "/static/"
# Who guesses tokens is not heard for a while; who has the cookie is.
TOO_MANY = Refusal(429, "too many wrong tokens: wait a minute", (("retry-after", "60"),))
_DEFAULT_PORTS = {"http": 80, "https": 443}


class Tokens:
    """Compares what clients show with the token, in constant time.

    Args:
        token: the token; None lets everybody pass.
    """

    def __init__(self, token: str | None) -> None:
        key = secrets.token_bytes(32)
        self.needed = token is not None
        self._token = _digest(token or "")
        self.cookie = hmac.new(key, (token or "").encode(), hashlib.sha256).hexdigest()
        self._cookie = _digest(self.cookie)

    def is_token(self, given: str) -> bool:
        """Whether a client's token is right."""
        return not self.needed or hmac.compare_digest(_digest(given), self._token)

    def has_cookie(self, headers: Mapping[str, str]) -> bool:
        """Whether a request has the cookie, or needs none."""
        shown = _cookie(headers.get("cookie", ""))
        return not self.needed or (shown is not None and hmac.compare_digest(_digest(shown), self._cookie))

    def has_bearer(self, headers: Mapping[str, str]) -> bool:
        """Whether a request has the token in ``Authorization``."""
        scheme, _, given = headers.get("authorization", "").partition(" ")
        return scheme.lower() == "bearer" and self.is_token(given.strip())


class Guard:
    """ASGI middleware: refuses requests and WebSockets by host, origin and token.

    Args:
        app: what is guarded.
        settings: names and origins that are allowed.
        tokens: compares tokens.
        failures: counts wrong tokens of an address.
    """

    def __init__(self, app: ASGIApp, settings: ServeSettings, tokens: Tokens, failures: Buckets) -> None:
        self._app, self._settings, self._tokens, self._failures = app, settings, tokens, failures
        self._names = _own_names(settings)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if refusal is not None:
            await refuse(scope, receive, send, refusal)
            return
        await self._app(scope, receive, send)

    def _refusal(self, scope: Scope) -> Refusal | None:
        headers = headers_of(scope)
        host = headers.get("host", "")
        if not self._is_own(host):
            return Refusal(421, "this server does not go by the name that it was called by: see --allow-host")
        origin = headers.get("origin")
        if origin is not None and not self._is_allowed(origin, host, scope):
            return Refusal(403, "pages of another site may not call this server")
        path = scope["path"]
        if path in _OPEN or (path.startswith(_OPEN_FOLDER) and scope["type"] == "http"):
            return None
        if self._tokens.has_cookie(headers):
            return None
        client = client_of(scope)
        if not self._failures.has_left(client):
            return TOO_MANY
        if self._tokens.has_bearer(headers):
            return None
        if "authorization" in headers:
            self._failures.take(client)
        return Refusal(401, "a token is needed: Authorization: Bearer TOKEN", (("www-authenticate", "Bearer"),))

    def _is_own(self, host: str) -> bool:
        """Whether a ``Host`` header names this server."""
        name = _name_of(host)
        if name is None:
            return False
        if is_loopback(self._settings.host):
            return is_loopback(name) or name in self._names
        # A name can be made to resolve to any address, an address cannot: it is what the client really called.
        return name in self._names or address_of(name) is not None or is_loopback(name)

    def _is_allowed(self, origin: str, host: str, scope: Scope) -> bool:
        if origin in self._settings.allowed_origins:
            return True
        given: str = scope.get("scheme", "http")
        scheme = {"ws": "http", "wss": "https"}.get(given, given)
        try:
            asked, own = urlsplit(origin), urlsplit(f"{scheme}://{host}")
            same_port = (asked.port or _DEFAULT_PORTS.get(asked.scheme)) == (own.port or _DEFAULT_PORTS[scheme])
        except (ValueError, KeyError):
            return False
        return asked.scheme == scheme and asked.hostname == own.hostname and same_port


class Headers:
    """ASGI middleware: the headers that tell browsers what a page may do.

    Args:
        app: whose answers get them.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Add the headers to an answer."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def add(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {name.lower() for name, _ in message.get("headers", ())}
                added = [pair for pair in _HEADERS if pair[0] not in given]
                if scope["path"].startswith("/api/") and b"cache-control" not in given:
                    added.append((b"cache-control", b"no-store"))
                message = {**message, "headers": [*message.get("headers", ()), *added]}
            await send(message)

        await self._app(scope, receive, add)


# The 3-D view is another server of this machine, on a port of its own.
_POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; frame-src 'self' http://127.0.0.1:* http://localhost:*; "
    "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
_HEADERS = (
    (b"content-security-policy", _POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"permissions-policy", b"camera=(), microphone=(), geolocation=()"),
)


def headers_of(scope: Scope) -> dict[str, str]:
    """The headers of a request, names in lower case; of one that is sent twice, both with a comma."""
    headers: dict[str, str] = {}
    for name, value in scope.get("headers", ()):
        key, text = name.decode("latin-1").lower(), value.decode("latin-1")
        headers[key] = f"{headers[key]},{text}" if key in headers else text
    return headers


def _own_names(settings: ServeSettings) -> frozenset[str]:
    names = {settings.host.strip("[]").lower(), *(name.lower() for name in settings.allowed_hosts)}
    if not is_loopback(settings.host):
        names.add(socket.gethostname().lower())
    return frozenset(names)


def _name_of(host: str) -> str | None:
    """The name in a ``Host`` header without its port, in lower case; None if it is none."""
    if not host or any(character in host for character in "/@?#, \\"):
        return None
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port  # raises for a port that is none
    except ValueError:
        return None
    return parts.hostname


def _cookie(header: str) -> str | None:
    """The cookie in a ``Cookie`` header."""
    try:
        found = SimpleCookie(header).get(COOKIE)
    except CookieError:
        return None
    return None if found is None else found.value


def _digest(text: str) -> bytes:
    """Of one length whatever the text's."""
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).digest()
