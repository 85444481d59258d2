"""``vecenv view``: results folders in the browser, of evaluations that run and of those that have ended.

One or two folders come in; the address of a page is printed, and the server runs until Ctrl-C or SIGTERM. It only
reads. The exit status is 2 when a folder holds no results or the arguments are wrong, and 1 when the server cannot
listen or a package is missing.
"""

from __future__ import annotations

import signal
import sys
from contextlib import suppress
from pathlib import Path

import typer

from vecenv.cli import fail
from vecenv.errors import VecenvError
from vecenv.util.extras import how_to_install, is_installed

# Requests a second of one address: a page that plays two recordings asks for 40 images.
_REQUESTS_PER_S = 200.0


def view_command(
    folder: Path = typer.Argument(
        ..., help="Results folder of `vecenv eval`, a folder of them (suites, seeds, shards), or a name in ./results."
    ),
    other: Path | None = typer.Argument(None, help="A second one, shown beside it.", show_default="none"),
    host: str = typer.Option("127.0.0.1", help="Address to listen on; others than loopback need a token."),
    port: int = typer.Option(8322, min=0, max=65535, help="TCP port; 0 for a free one, which is printed."),
    token_file: Path | None = typer.Option(
        None,
        help="File with the token that readers must show; also from VECENV_TOKEN. Loopback needs none, and for other "
        "addresses one is made and printed.",
        show_default="none",
    ),
    open_browser: bool = typer.Option(True, "--open/--no-open", help="Open the page in a browser."),
    allow_host: list[str] = typer.Option([], help="A further name that the server is called by; repeatable."),
) -> None:
    """Look at evaluations in the browser, while they run and afterwards: success, episodes, recordings, two runs."""
    for module in ("fastapi", "uvicorn", "PIL", "av", "h5py"):
        if not is_installed(module):
            fail(how_to_install(module), code=1)
    from vecenv_eval.store import StoreError
    from vecenv_eval.web.runs import open_runs
    from vecenv_eval.web.server import ServerError
    from vecenv_eval.web.settings import ServeSettings, is_loopback, new_token, read_token

    try:
        readers = open_runs([each for each in (folder, other) if each is not None])
        token = read_token(token_file)
        if token is None and not is_loopback(host):
            token = new_token()
            typer.echo(f"token: {token}", err=True)
        settings = ServeSettings(
            host=host, token=token, allowed_hosts=tuple(allow_host), requests_per_second=_REQUESTS_PER_S, nodes=False
        )
    except (StoreError, VecenvError) as error:
        fail(" ".join(str(error).split()))
    from vecenv_eval.web.app import create_app
    from vecenv_eval.web.routes_runs import runs_router
    from vecenv_eval.web.server import Server

    # A shell that starts it in the background makes it deaf to Ctrl-C's signal; `kill -INT` must still stop it.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    try:
        server = Server(create_app(None, settings, routers=[runs_router(readers)]), port)
    except ServerError as error:
        fail(str(error), code=1)

    def started() -> None:
        address = f"{server.url}/view"
        typer.echo(f"viewing {' and '.join(str(each.folder) for each in readers)} on {address}")
        sys.stdout.flush()
        if open_browser:
            import webbrowser

            webbrowser.open(address)

    server.on_start(started)
    with suppress(KeyboardInterrupt):  # uvicorn raises the signal again when it has stopped
        server.run()
    typer.echo("stopped")
