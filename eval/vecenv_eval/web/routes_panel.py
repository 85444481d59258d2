"""Routes that build, drive and read the session, and the login."""

from __future__ import annotations

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


def panel_router(context: Context, session: Session) -> APIRouter:
    """The routes of a session."""
    router = APIRouter(prefix="/api", tags=["session"])
    settings = context.settings

    def own_state(writer: str | None, slot: int = 0) -> SessionState:
        context.writers.touch(writer)
        held = context.writers.is_held(SESSION)
        own = context.writers.holds(SESSION, writer)
        return replace(session.state(slot), writer=own, writer_held=held, url_3d=context.url_3d)

    @router.get("/session")
    def read(slot: Slot = 0, writer: WriterName = None) -> SessionState:
        """The session as it is now; ``planning`` is of ``slot``."""
        return own_state(writer, slot)

    @router.get("/session/history")
    def history(slot: Slot = 0, writer: WriterName = None) -> History:
        """What was recorded of the episode that a slot runs, one row a control tick."""
        context.writers.touch(writer)
        return session.history(slot)

    @router.post("/session", status_code=202, responses=CONFLICT)
    def build(body: SessionBody, writer: WriterName = None) -> SessionState:
        """Build a batch and a policy; the session is "building", then "ready" or "error"."""
        context.writers.claim(SESSION, writer)
        check_request(body, settings, session.base)
        session.build(session.config_of(body.suite, **_changes(body, settings.max_slots)))
        return own_state(writer)

    @router.post("/session/speed", responses=CONFLICT)
    def speed(body: SpeedBody, writer: WriterName = None) -> SessionState:
        """Limit the speed."""
        context.writers.claim(SESSION, writer)
        session.set_speed(body.ticks_per_second)
        return own_state(writer)

    @router.post("/panel/fields", responses=CONFLICT)
    def choose(body: FieldBody, writer: WriterName = None) -> FieldAnswer:
        """Choose a suite, a task or an episode, which is placed in one slot."""
        context.writers.claim(SESSION, writer)
        fields = session.set_field(body.name, body.value)
        return FieldAnswer(fields=fields, snapshot=fields)

    @router.post("/panel/actions", responses=CONFLICT)
    def act(body: ActionBody, writer: WriterName = None) -> ActionAnswer:
        """Play, pause, step, stop or reset."""
        context.writers.claim(SESSION, writer)
        signal = session.act(body.action, body.ticks)
        state = own_state(writer)
        return ActionAnswer(state=state.state, signal_name=signal, session=state)

    @router.delete("/writer")
    def release(writer: WriterName = None) -> Done:
        """Let go of everything that this client drives."""
        if writer is None:
            raise Refused(400, "the header X-Writer names the client that lets go", "X-Writer")
        context.writers.release(writer)
        return Done()

    return router
