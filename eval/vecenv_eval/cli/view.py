"""``vecenv view``: results folders in the browser, of evaluations that run and of those that have ended.

One or two folders come in; the address of a page is printed, and the server runs until Ctrl-C or SIGTERM. It only
reads. The exit status is 2 when a folder holds no results or the arguments are wrong, and 1 when the server cannot
listen or a package is missing.
"""

from __future__ import annotations

from pathlib import Path

import typer

from vecenv.cli import fail
from vecenv.errors import VecenvError
from vecenv_eval.cli import listening

# Requests a second of one address: a page that plays two recordings asks for 40 images.
_REQUESTS_PER_S = 200.0


def view_command(
    folder: Path = typer.Argument(
        ..., help="Results folder of `vecenv eval`, a folder of them (suites, seeds, shards), or a name in ./results."
    ),
    other: Path | None = typer.Argument(None, help="A second one, shown beside it.", show_default="none"),
    host: str = listening.HOST,
    port: int = listening.port_option(8322),
    token_file: Path | None = listening.TOKEN_FILE,
    open_browser: bool = listening.OPEN,
    allow_host: list[str] = listening.ALLOW_HOST,
) -> None:
    """Look at evaluations in the browser, while they run and afterwards: success, episodes, recordings, two runs."""
    listening.need("fastapi", "uvicorn", "PIL", "av", "h5py")
    from vecenv_eval.store import StoreError
    from vecenv_eval.web.runs import open_runs
    from vecenv_eval.web.server import ServerError
    from vecenv_eval.web.settings import ServeSettings

    try:
        readers = open_runs([each for each in (folder, other) if each is not None])
        settings = ServeSettings(
            host=host,
            token=listening.token_of(host, token_file),
            allowed_hosts=tuple(allow_host),
            requests_per_second=_REQUESTS_PER_S,
            nodes=False,
        )
    except (StoreError, VecenvError) as error:
        fail(" ".join(str(error).split()))
    from vecenv_eval.web.app import create_app
    from vecenv_eval.web.routes_runs import runs_router
    from vecenv_eval.web.server import Server

    listening.heed_signals()
    try:
        server = Server(create_app(None, settings, routers=[runs_router(readers)]), port)
    except ServerError as error:
        fail(str(error), code=1)

    folders = " and ".join(str(each.folder) for each in readers)
    listening.run(server, lambda address: f"viewing {folders} on {address}", path="/view", open_browser=open_browser)
    typer.echo("stopped")
