"""``vecenv serve``: a live batch of environments in the browser, and over HTTP.

Options as those of ``vecenv eval`` say what is built at first; the address is printed, and the server runs until Ctrl-C
or SIGTERM. Episodes that have ended by then are in the results folder. The exit status is 2 when the arguments are
wrong and 1 when the server cannot listen.
"""

from __future__ import annotations

import logging
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from vecenv.cli import fail
from vecenv.util.logs import Saying, reported, to_stderr
from vecenv_eval.cli import listening
from vecenv_eval.cli.options import some_settings, user_errors, with_settings
from vecenv_eval.config import EvalConfig

if TYPE_CHECKING:
    from vecenv_eval.web.settings import ServeSettings

# Settings of an evaluation that the command has.
SETTINGS = (
    "suite",
    "policy",
    "tasks",
    "episodes",
    "policy_args",
    "protocol",
    "backend",
    "max_steps",
    "seed",
    "image_size",
    "lod",
    "colors",
    "cameras",
    "env_args",
    "num_envs",
    "num_threads",
)
_SHOWN = {"suite": "none: clients choose", "tasks": "0", "episodes": "the first", "num_envs": "--max-slots"}
_HELPS = {
    "suite": "Suite to begin with; `vecenv list` names them.",
    "policy": "Policy to begin with, as of `vecenv eval`.",
    "tasks": "Tasks to begin with: all, or indices, ranges, names and patterns.",
    "episodes": "Episodes of each to begin with: all, a count, or indices and ranges.",
    "num_envs": "Slots to begin with.",
}


def _serve(
    config: Path | None = typer.Option(None, help="YAML file of settings, as of `vecenv eval`; options override it."),
    out: Path | None = typer.Option(
        None, help="Folder below which every run gets a results folder.", show_default="results are not kept"
    ),
    host: str = listening.HOST,
    port: int = listening.port_option(8321),
    token_file: Path | None = listening.TOKEN_FILE,
    open_browser: bool = listening.OPEN,
    play: bool = typer.Option(False, "--play", help="Play at once."),
    trust_clients: bool = typer.Option(
        False,
        "--trust-clients",
        help="Clients may name module:Class policies, policy servers, language models and files: they can run any code "
        "as you.",
    ),
    max_slots: int = typer.Option(64, min=1, max=4096, help="Most slots of a batch that a client builds."),
    allow_host: list[str] = listening.ALLOW_HOST,
    allow_origin: list[str] = typer.Option([], help="A further origin whose pages may call; repeatable."),
    access_log: bool = typer.Option(False, "--access-log", help="Print a line for every request."),
    view_3d: bool = typer.Option(
        False, "--view-3d", help="Also serve a 3-D view, on a port of its own of this machine, without the token."
    ),
    port_3d: int | None = typer.Option(
        None, "--port-3d", min=0, max=65535, help="Port of the 3-D view.", show_default="a free one"
    ),
    **settings: Any,
) -> None:
    """Drive and watch a live batch of environments in the browser."""
    if port_3d is not None and not view_3d:
        fail("--port-3d needs --view-3d")
    listening.need("fastapi", "uvicorn", "PIL", *(["viser"] if view_3d else []))
    sys.path.append(str(Path.cwd()))  # so that --policy module:Class finds a module beside the user
    with user_errors():
        first = _first(settings, config)
        served = _settings(host, token_file, trust_clients, max_slots, allow_host, allow_origin)
        ports = (port, (port_3d or 0) if view_3d else None)
        _run(first, served, out, ports, open_browser=open_browser, play=play, access_log=access_log)


def _first(settings: dict[str, Any], file: Path | None) -> EvalConfig | None:
    """What is built at first; None without a suite."""
    given = some_settings(settings, file, SETTINGS, "serve")
    if not given.get("suite"):
        if given:
            fail(f"--suite is needed with {', '.join(given)}; `vecenv list` names the suites")
        return None
    return EvalConfig.from_dict({"tasks": "0", "episodes": "0-0", **given})


def _settings(
    host: str, token_file: Path | None, trust: bool, max_slots: int, hosts: list[str], origins: list[str]
) -> ServeSettings:
    from vecenv_eval.web.settings import ServeSettings

    return ServeSettings(
        host=host,
        token=listening.token_of(host, token_file),
        allowed_hosts=tuple(hosts),
        allowed_origins=tuple(origins),
        trust_clients=trust,
        max_slots=max_slots,
    )


def _run(
    first: EvalConfig | None,
    settings: ServeSettings,
    out: Path | None,
    ports: tuple[int, int | None],
    *,
    open_browser: bool,
    play: bool,
    access_log: bool,
) -> None:
    from vecenv_eval.panel.choices import check_live
    from vecenv_eval.panel.session import Session
    from vecenv_eval.web.app import create_app
    from vecenv_eval.web.routes_runs import runs_router
    from vecenv_eval.web.server import Server

    if first is not None:
        check_live(first)
    listening.heed_signals()  # after SIGTERM too the session is closed, and what has ended summarised
    if access_log:
        logger = logging.getLogger("vecenv_eval.web.access")
        logger.setLevel(logging.INFO)
        logger.addHandler(Saying(to_stderr))
    scene = None
    if ports[1] is not None:
        from vecenv_eval.web.scene3d import Scene3D

        scene = Scene3D(ports[1])
    with (
        suppress(KeyboardInterrupt),
        reported(),
        Session(first, out=out, max_slots=settings.max_slots, play=play) as session,
    ):
        # What `vecenv view` shows of a results folder, of the runs of this server.
        runs = [] if out is None else [runs_router([], drives=True, below=out)]
        app = create_app(session, settings, routers=runs)
        if scene is not None:
            from vecenv_eval.web.routes_view3d import attach_view3d

            attach_view3d(app, session, scene)
        server = Server(app, ports[0])

        asks = " (the page asks for the token)" if settings.token else ""
        listening.run(server, lambda address: f"serving on {address}{asks}", open_browser=open_browser)
    typer.echo("stopped")


serve_command = with_settings(_serve, SETTINGS, shown=_SHOWN, helps=_HELPS)

if __name__ == "__main__":  # where the console command is not installed
    typer.run(serve_command)
