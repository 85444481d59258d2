"""What the commands that listen on an address share (`vecenv serve`, `vecenv view`): options, token, signals."""

from __future__ import annotations

import signal
import sys
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from vecenv.cli import fail
from vecenv.util.extras import how_to_install, is_installed

if TYPE_CHECKING:
    from vecenv_eval.web.server import Server

HOST: Any = typer.Option("127.0.0.1", help="Address to listen on; others than loopback need a token.")
TOKEN_FILE: Any = typer.Option(
    None,
    help="File with the token that clients must show; also from VECENV_TOKEN. Loopback needs none, and for other "
    "addresses one is made and printed.",
    show_default="none",
)
OPEN: Any = typer.Option(True, "--open/--no-open", help="Open the page in a browser.")
ALLOW_HOST: Any = typer.Option([], help="A further name that the server is called by; repeatable.")


def port_option(default: int) -> Any:
    """The option ``--port``."""
    return typer.Option(default, min=0, max=65535, help="TCP port; 0 for a free one, which is printed.")


def need(*modules: str) -> None:
    """End with the command that installs a package, with exit status 1, where one is missing."""
    for module in modules:
        if not is_installed(module):
            fail(how_to_install(module), code=1)


def token_of(host: str, file: Path | None) -> str | None:
    """The token that was given; without one, a new one for an address other than loopback, which is printed.

    Raises:
        ServeError: the token's file cannot be used.
    """
    from vecenv_eval.web.settings import is_loopback, new_token, read_token

    token = read_token(file)
    if token is None and not is_loopback(host):
        token = new_token()
        typer.echo(f"token: {token}", err=True)
    return token


def heed_signals() -> None:
    """Have SIGINT and SIGTERM both end the command in order.

    A shell that starts it in the background makes it deaf to Ctrl-C's signal; ``kill -INT`` must still stop it.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)


def run(server: Server, said: Callable[[str], str], *, path: str = "", open_browser: bool) -> None:
    """Serve until a signal comes, in the main thread.

    Args:
        server: where.
        said: what is printed once requests are answered, of the page's address.
        path: of the page below the server's address.
        open_browser: open it in the browser.
    """

    def started() -> None:
        address = server.url + path
        typer.echo(said(address))
        sys.stdout.flush()
        if open_browser:
            webbrowser.open(address)

    server.on_start(started)
    with suppress(KeyboardInterrupt):  # uvicorn raises the signal again when it has stopped
        server.run()
