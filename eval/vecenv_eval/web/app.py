"""The application: routes, the page's files, security and limits around them.

For development and tests, on a free port and in a thread::

    from vecenv_eval.panel.session import Session
    from vecenv_eval.web.app import create_app
    from vecenv_eval.web.server import running

    with Session() as session, running(create_app(session)) as server:
        print(server.url)  # "http://127.0.0.1:40123"

or from a shell: ``vecenv serve --suite libero_object --port 0 --no-open`` prints the address. Without a console
command: ``python -m vecenv_eval.cli.serve --suite libero_object --port 0 --no-open``.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import APIRouter, FastAPI
from fastapi.responses import FileResponse, Response
from fastapi.staticfiles import StaticFiles

import vecenv
from vecenv_eval.panel.session import Session
from vecenv_eval.web.access import AccessLog
from vecenv_eval.web.context import Context
from vecenv_eval.web.errors import Refused, install_handlers
from vecenv_eval.web.limits import Limits
from vecenv_eval.web.models import ErrorBody, Health
from vecenv_eval.web.routes_catalog import catalog_router
from vecenv_eval.web.routes_frames import frames_router
from vecenv_eval.web.routes_panel import login_router, panel_router
from vecenv_eval.web.security import Guard, Headers
from vecenv_eval.web.settings import ServeSettings

STATIC = Path(__file__).parent / "static"
# Pages of the package by address.
_PAGES = {"/": "index.html", "/view": "view.html"}


def create_app(
    session: Session | None = None,
    settings: ServeSettings | None = None,
    *,
    routers: Sequence[APIRouter] = (),
    static: Path = STATIC,
) -> FastAPI:
    """The application.

    Args:
        session: what is driven; None serves no session (its routes are not there).
        settings: security and limits; loopback without a token when not given.
        routers: further routes, such as those of ``vecenv view``.
        static: folder of the page's files.
    """
    settings = settings or ServeSettings()
    context = Context(session, settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        await context.close()

    app = FastAPI(
        title="vecenv",
        version=vecenv.__version__,
        summary="A live batch of environments: built, driven and watched.",
        openapi_url="/api/openapi.json",
        docs_url=None,  # they load scripts from elsewhere
        redoc_url=None,
        lifespan=lifespan,
        responses={code: {"model": ErrorBody} for code in (400, 401, 403, 404, 405, 408, 413, 421, 422, 429, 503)},
    )
    app.state.context = context
    install_handlers(app)

    @app.get("/api/health", tags=["server"])
    async def health() -> Health:
        """The server runs."""
        return Health(version=vecenv.__version__)

    for router in (login_router(context), catalog_router(settings), *routers):
        app.include_router(router)
    if session is not None:
        app.include_router(panel_router(context, session))
        app.include_router(frames_router(context, session))
    if settings.nodes and session is not None:
        from vecenv_eval.web.routes_nodes import nodes_router

        app.include_router(nodes_router(context))
    _add_pages(app, static)
    app.add_middleware(Limits, settings=settings)
    app.add_middleware(Guard, settings=settings, tokens=context.tokens, failures=context.failures)
    app.add_middleware(Headers)
    app.add_middleware(AccessLog)
    return app


def _add_pages(app: FastAPI, static: Path) -> None:
    """The files of the page; an address without its file says so."""

    def page(name: str) -> Response:
        if not (static / name).is_file():
            raise Refused(404, f"this installation has no page {name}: the API is at /api/openapi.json")
        return FileResponse(static / name, headers={"cache-control": "no-cache"})

    for address, name in _PAGES.items():
        app.add_api_route(address, lambda name=name: page(name), include_in_schema=False, response_model=None)
    if static.is_dir():
        app.mount("/static", StaticFiles(directory=static), name="static")
