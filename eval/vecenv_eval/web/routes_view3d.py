"""The 3-D view beside a session: it sees the environment, and a reader of the page says which slot it shows."""

from __future__ import annotations

from contextlib import suppress
from typing import Annotated

from fastapi import APIRouter, FastAPI
from pydantic import Field

from vecenv_eval.panel.session import Session
from vecenv_eval.panel.state import SessionClosed
from vecenv_eval.web.context import Context
from vecenv_eval.web.models import MOST_SLOTS, Body, Done
from vecenv_eval.web.scene3d import Scene3D


class SlotBody(Body):
    """A slot to show."""

    slot: Annotated[int, Field(ge=0, lt=MOST_SLOTS)]


def attach_view3d(app: FastAPI, session: Session, scene: Scene3D) -> None:
    """Have a 3-D view follow a session, and the page show it; it is closed with the application."""
    context: Context = app.state.context

    def look() -> None:
        with suppress(SessionClosed):
            session.call(scene.look)

    scene.on_due = look
    context.url_3d = scene.url
    context.on_close(scene.close)
    session.observe(scene)
    router = APIRouter(prefix="/api", tags=["session"])

    @router.post("/view3d")
    def follow(body: SlotBody) -> Done:
        """Show a slot in the 3-D view, to everybody who looks at it."""
        scene.follow(body.slot)
        return Done()

    app.include_router(router)
