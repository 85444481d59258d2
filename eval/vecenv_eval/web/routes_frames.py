"""The stream: one WebSocket a reader, with the session's state as text and images as binary messages.

A reader says what it wants to see (``models.StreamMessage``), as often as it likes. It gets the newest frame and skips
those that it was too slow for: the server holds no frame for it beyond the one that is being sent. State and frames are
encoded once, however many readers want the same.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from dataclasses import replace

from fastapi import APIRouter, WebSocket
from pydantic import TypeAdapter, ValidationError
from starlette.websockets import WebSocketDisconnect, WebSocketState

from vecenv_eval.panel.frames import WALL, Key, View
from vecenv_eval.panel.session import Session
from vecenv_eval.panel.state import SessionState
from vecenv_eval.web.context import SESSION, Context
from vecenv_eval.web.errors import error_body
from vecenv_eval.web.limits import Buckets, is_deeper
from vecenv_eval.web.models import StreamMessage, Subscription

_log = logging.getLogger(__name__)
# Seconds between two states for a reader at least, and bytes a second of states at most.
_STATE_S, _STATE_BYTES_S = 0.1, 400_000
# Seconds between two looks at whether something has changed, for all readers together.
_PULSE_S = 1 / 60
# Messages that cannot be read before a reader is disconnected.
_MOST_MISTAKES = 20
_STATES = TypeAdapter(SessionState)


class Broadcast:
    """Tells readers when something has changed, and encodes states once.

    Args:
        session: what is read.
        context: the writers.
    """

    def __init__(self, session: Session, context: Context) -> None:
        self._session, self._context = session, context
        self._changed = asyncio.Event()
        self._pulse: asyncio.Task[None] | None = None
        self._readers = 0
        self._texts: dict[tuple[int, bool], tuple[object, str]] = {}

    def enter(self) -> None:
        """A reader comes."""
        self._readers += 1
        if self._pulse is None or self._pulse.done():
            self._pulse = asyncio.get_running_loop().create_task(self._watch())

    def leave(self) -> None:
        """A reader goes; without any, nothing is watched."""
        self._readers -= 1
        if not self._readers and self._pulse is not None:
            self._pulse.cancel()
            self._pulse = None
            self._texts.clear()

    async def wait(self, timeout: float) -> None:
        """Wait for a change."""
        changed = self._changed
        try:
            async with asyncio.timeout(timeout):
                await changed.wait()
        except TimeoutError:
            pass

    def stamp(self) -> tuple[object, ...]:
        """Changes whenever the state that readers get would."""
        held = self._context.writers.is_held(SESSION)
        frames = self._session.frames
        return (*self._session.version, held, self._context.url_3d, frames.error, frames.preparing)

    def text(self, slot: int, writer: str | None) -> str:
        """The state as a message; of one slot's plan."""
        own, stamp = self._context.writers.holds(SESSION, writer), self.stamp()
        found = self._texts.get((slot, own))
        if found is None or found[0] != stamp:
            held = self._context.writers.is_held(SESSION)
            state = replace(self._session.state(slot), writer=own, writer_held=held, url_3d=self._context.url_3d)
            text = '{"type":"session",' + _STATES.dump_json(state).decode()[1:]
            if len(self._texts) > 1000:
                self._texts.clear()
            found = self._texts[slot, own] = (stamp, text)
        return found[1]

    async def _watch(self) -> None:
        before: object = None
        while True:
            now = (self.stamp(), self._session.frames.encoded)
            if now != before:
                before, changed = now, self._changed
                self._changed = asyncio.Event()
                changed.set()
            await asyncio.sleep(_PULSE_S)


class Reader:
    """One reader of the stream.

    Args:
        socket: its connection, accepted.
        session, context, broadcast: what it reads.
    """

    def __init__(self, socket: WebSocket, session: Session, context: Context, broadcast: Broadcast) -> None:
        self._socket, self._session, self._context, self._broadcast = socket, session, context, broadcast
        self._wanted = Subscription()
        self._writer: str | None = None
        self._sent: dict[Key, int] = {}
        self._due: dict[Key, float] = {}
        self._state_due, self._state_sent = 0.0, ""
        self._error_sent: str | None = None

    async def run(self) -> None:
        """Send until the reader goes or the server stops."""
        listening = asyncio.create_task(self._listen())
        sending = asyncio.create_task(self._send_all())
        closing = asyncio.create_task(self._context.closing.wait())
        tasks = {listening, sending, closing}
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            ended = await asyncio.gather(*tasks, return_exceptions=True)
        for error in ended:
            if isinstance(error, Exception) and not isinstance(error, WebSocketDisconnect | TimeoutError | OSError):
                _log.warning("a reader of the stream was lost", exc_info=error)
        await self._close(1012 if self._context.closing.is_set() else 1008)

    async def _close(self, code: int) -> None:
        if self._socket.client_state == WebSocketState.CONNECTED == self._socket.application_state:
            try:
                async with asyncio.timeout(1):
                    await self._socket.close(code)
            except (TimeoutError, RuntimeError, OSError):
                pass  # it is gone already

    async def _listen(self) -> None:
        """Read what the reader wants, until it has sent too much that cannot be read."""
        settings = self._context.settings
        rate = Buckets(settings.messages_per_second, settings.messages_per_second * 2)
        mistakes = 0
        while mistakes < _MOST_MISTAKES:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            text = message.get("text")
            if not rate.take(""):
                sentence: str | None = "too many messages: slow down"
            elif text is None:
                sentence = "messages are JSON as text"
            else:
                sentence = self._read(text)
            if sentence is not None:
                mistakes += 1
                await self._send(json.dumps({"type": "error", **error_body(sentence)}))

    def _read(self, text: str) -> str | None:
        """Take over what a message says; returns what is wrong with it."""
        settings = self._context.settings
        data = text.encode("utf-8", "surrogatepass")
        if len(data) > settings.max_message or is_deeper(data, settings.max_depth):
            return f"a message is at most {settings.max_message} bytes and {settings.max_depth} levels"
        try:
            message = StreamMessage.model_validate_json(data)
        except ValidationError as error:
            first = error.errors()[0]
            return f"{'.'.join(map(str, first['loc'])) or 'the message'}: {first['msg']}"
        if message.writer is not None:
            self._writer = message.writer
            self._context.writers.touch(message.writer)
        if message.subscribe is not None:
            self._wanted = message.subscribe
            keys = self._keys()
            self._sent = {key: number for key, number in self._sent.items() if key in keys}
            self._due = {key: due for key, due in self._due.items() if key in keys}
        return None

    def _keys(self) -> list[Key]:
        wanted = self._wanted
        views: list[Key] = [View(wanted.slot, name, wanted.size) for name in dict.fromkeys(wanted.cameras)]
        return [*views, *([WALL] if wanted.wall else [])]

    async def _send_all(self) -> None:
        while True:
            await self._send_state()
            for key in self._keys():
                await self._send_frame(key)
            now = time.monotonic()
            dues = [self._state_due, *(self._due.get(key, 0.0) for key in self._keys())]
            # Nothing can be sent before the first of them; then a change is waited for.
            await asyncio.sleep(max(0.0, min(dues) - now))
            later = [due - time.monotonic() for due in dues if due > time.monotonic()]
            await self._broadcast.wait(max(0.001, min([1.0, *later])))

    async def _send_state(self) -> None:
        now = time.monotonic()
        if now < self._state_due:
            return
        error = self._session.frames.error
        if error != self._error_sent:
            self._error_sent = error
            if error is not None:
                await self._send(json.dumps({"type": "error", **error_body(error)}))
        text = self._broadcast.text(self._wanted.slot, self._writer)
        if text != self._state_sent:
            self._state_sent = text
            self._state_due = now + max(_STATE_S, len(text) / _STATE_BYTES_S)
            await self._send(text)

    async def _send_frame(self, key: Key) -> None:
        now = time.monotonic()
        if now < self._due.get(key, 0.0):
            return
        frame = self._session.frames.newest(key)
        if frame is not None and frame.number != self._sent.get(key):
            self._sent[key] = frame.number
            self._due[key] = now + 1 / self._wanted.fps
            await self._send(frame.message)
        else:
            self._session.frames.want(key)

    async def _send(self, message: str | bytes) -> None:
        """Send one message; a reader that takes too long for it is lost."""
        async with asyncio.timeout(self._context.settings.send_timeout_s):
            if isinstance(message, str):
                await self._socket.send_text(message)
            else:
                await self._socket.send_bytes(message)


def frames_router(context: Context, session: Session) -> APIRouter:
    """The stream."""
    router = APIRouter()
    broadcast = Broadcast(session, context)

    @router.websocket("/api/stream")
    async def stream(socket: WebSocket) -> None:
        """States and images; see the module."""
        if context.streams >= context.settings.max_streams or context.closing.is_set():
            await socket.close(1013, "there are too many readers")
            return
        context.streams += 1
        broadcast.enter()
        try:
            await socket.accept()
            await Reader(socket, session, context, broadcast).run()
        finally:
            broadcast.leave()
            context.streams -= 1

    return router
