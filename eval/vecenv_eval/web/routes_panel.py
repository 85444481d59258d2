"""Routes that build, drive and read the session, and the login."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from vecenv_eval.panel.session import Session
from vecenv_eval.panel.state import History, SessionState
from vecenv_eval.web.context import SESSION, Context
from vecenv_eval.web.errors import Refused
from vecenv_eval.web.limits import client_of
from vecenv_eval.web.models import (
    CONFLICT,
    MOST_SLOTS,
    ActionAnswer,
    ActionBody,
    Done,
    FieldAnswer,
    FieldBody,
    LoginBody,
    SessionBody,
    SpeedBody,
)
from vecenv_eval.web.permissions import check_request
from vecenv_eval.web.security import COOKIE, TOO_MANY
from vecenv_eval.web.writer import WriterName

# Requests that may wait for the session at once.
_MOST_WAITING = 8
Slot = Annotated[int, Query(ge=0, lt=MOST_SLOTS)]


def _changes(body: SessionBody, max_slots: int) -> dict[str, Any]:
    """Settings of an evaluation that a body says; what it leaves out stays as it is."""
    changes: dict[str, Any] = {
        "tasks": body.tasks,
        "episodes": body.episodes,
        "num_envs": min(body.num_slots or max_slots, max_slots),
    }
    if body.policy is not None:
        changes |= {"policy": body.policy, "policy_args": body.policy_args}
    if body.env_args:
        changes["env_args"] = body.env_args
    if body.seed is not None:
        changes["seed"] = body.seed
    return changes


def login_router(context: Context) -> APIRouter:
    """The login."""
    router = APIRouter(prefix="/api", tags=["server"])

    @router.post("/login")
    def login(body: LoginBody, request: Request, response: Response) -> Done:
        """Exchange the token for a cookie, which the page's requests then carry."""
        client = client_of(request.scope)
        if not context.failures.has_left(client):
            raise Refused(TOO_MANY.status, TOO_MANY.sentence, retry_after="60")
        if not context.tokens.is_token(body.token):
            context.failures.take(client)
            raise Refused(401, "the token is wrong", "token")
        secure = request.url.scheme == "https"
        response.set_cookie(COOKIE, context.tokens.cookie, httponly=True, samesite="strict", secure=secure)
        return Done()

    return router


class _Driving:
    """What the routes of a session share."""

    def __init__(self, context: Context, session: Session) -> None:
        self.context, self.session = context, session
        self._line = threading.BoundedSemaphore(_MOST_WAITING)

    def state(self, writer: str | None, slot: int = 0) -> SessionState:
        """The state as a client sees it, which has shown itself with that."""
        writers = self.context.writers
        writers.touch(writer)
        own, held = writers.holds(SESSION, writer), writers.is_held(SESSION)
        return replace(self.session.state(slot), writer=own, writer_held=held, url_3d=self.context.url_3d)

    @contextmanager
    def writing(self, writer: str | None) -> Iterator[None]:
        """A client changes the session: one of a few requests that wait for it.

        They take threads, of which requests that only read need some too.
        """
        self.context.writers.claim(SESSION, writer)
        if not self._line.acquire(blocking=False):
            raise Refused(503, f"{_MOST_WAITING} requests wait for the session already", retry_after="1")
        try:
            yield
        finally:
            self._line.release()


def panel_router(context: Context, session: Session) -> APIRouter:
    """The routes of a session."""
    router, driving = APIRouter(prefix="/api", tags=["session"]), _Driving(context, session)
    _add_reading(router, driving)
    _add_building(router, driving)
    _add_acting(router, driving)
    return router


def _add_reading(router: APIRouter, driving: _Driving) -> None:
    @router.get("/session")
    async def read(slot: Slot = 0, writer: WriterName = None) -> SessionState:
        """The session as it is now; ``planning`` is of ``slot``."""
        return driving.state(writer, slot)

    @router.get("/session/history")
    def history(slot: Slot = 0, writer: WriterName = None) -> History:
        """What was recorded of the episode that a slot runs, one row a control tick."""
        driving.context.writers.touch(writer)
        return driving.session.history(slot)

    @router.delete("/writer")
    def release(writer: WriterName = None) -> Done:
        """Let go of everything that this client drives."""
        if writer is None:
            raise Refused(400, "the header X-Writer names the client that lets go", "X-Writer")
        driving.context.writers.release(writer)
        return Done()


def _add_building(router: APIRouter, driving: _Driving) -> None:
    session, settings = driving.session, driving.context.settings

    @router.post("/session", status_code=202, responses=CONFLICT)
    def build(body: SessionBody, writer: WriterName = None) -> SessionState:
        """Build a batch and a policy; the session is "building", then "ready" or "error"."""
        with driving.writing(writer):
            check_request(body, settings, session.base)
            session.build(session.config_for(body.suite, **_changes(body, settings.max_slots)))
        return driving.state(writer)

    @router.post("/panel/fields", responses=CONFLICT)
    def choose(body: FieldBody, writer: WriterName = None) -> FieldAnswer:
        """Choose a suite, a task or an episode, which is placed in one slot."""
        with driving.writing(writer):
            fields = session.set_field(body.name, body.value)
        return FieldAnswer(fields=fields, snapshot=fields)


def _add_acting(router: APIRouter, driving: _Driving) -> None:
    @router.post("/panel/actions", responses=CONFLICT)
    def act(body: ActionBody, writer: WriterName = None) -> ActionAnswer:
        """Play, pause, step, stop or reset."""
        with driving.writing(writer):
            signal = driving.session.act(body.action, body.ticks)
        state = driving.state(writer)
        return ActionAnswer(state=state.state, signal_name=signal, session=state)

    @router.post("/session/speed", responses=CONFLICT)
    def speed(body: SpeedBody, writer: WriterName = None) -> SessionState:
        """Limit the speed."""
        with driving.writing(writer):
            driving.session.set_speed(body.ticks_per_second)
        return driving.state(writer)
