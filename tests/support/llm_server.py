"""A real server on this machine that speaks OpenAI's chat protocol and answers as it is told, misbehaving included."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What the server sends for one request.

    Attributes:
        status: HTTP status.
        body: sent as it is if it is text, as JSON otherwise.
        headers: besides the content's type and length.
        hang: the connection stays open without a byte until the server closes.
        cut: only this many bytes of the body are sent before the connection closes, None for all.
    """

    status: int = 200
    body: Any = ""
    headers: Mapping[str, str] = field(default_factory=dict)
    hang: bool = False
    cut: int | None = None


def code(text: str | None, *, finish: str = "stop", prompt_tokens: int = 11, completion_tokens: int = 7) -> Answer:
    """A complete reply of a chat model."""
    choice = {"index": 0, "message": {"role": "assistant", "content": text}, "finish_reason": finish}
    usage = {
        "prompt_tokens": prompt_tokens,
        "completion_tokens": completion_tokens,
        "total_tokens": prompt_tokens + completion_tokens,
    }
    body = {"id": "reply-1", "object": "chat.completion", "created": 0, "model": "local", "choices": [choice]}
    return Answer(body=body | {"usage": usage})


def failure(status: int, message: str, code: str | None = None, **headers: str) -> Answer:
    """An error in OpenAI's form; underscores in header names stand for hyphens."""
    error = {"error": {"message": message, "type": code or "server_error", "code": code}}
    return Answer(status=status, body=error, headers={name.replace("_", "-"): value for name, value in headers.items()})


HANG = Answer(hang=True)


class LlmServer:
    """The running server: where it is, what it was asked, what it will answer.

    Attributes:
        base: address for ``api_base``.
        requests: bodies of the requests so far.
        answer: called with the body of each request; it may wait.
        in_flight: requests that wait for an answer now, and the most there have been.
    """

    def __init__(self, base: str) -> None:
        self.base = base
        self.requests: list[dict[str, Any]] = []
        self.answer: Callable[[dict[str, Any]], Answer] = lambda request: code("pass")
        self.closing = threading.Event()
        self.in_flight, self.most_in_flight = 0, 0
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def counted(self) -> Iterator[None]:
        """Inside, a request waits for its answer."""
        with self._lock:
            self.in_flight += 1
            self.most_in_flight = max(self.most_in_flight, self.in_flight)
        try:
            yield
        finally:
            with self._lock:
                self.in_flight -= 1

    def say(self, *answers: Answer | str) -> None:
        """Answer the next requests with these in turn, and all later ones with the last."""
        pending = [code(answer) if isinstance(answer, str) else answer for answer in answers]
        self.answer = lambda request: pending.pop(0) if len(pending) > 1 else pending[0]


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    llm: LlmServer

    def do_POST(self) -> None:
        request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.llm.requests.append(request)
        with self.llm.counted():
            answer = self.llm.answer(request)
        if answer.hang:
            self.llm.closing.wait()
            return
        data = (answer.body if isinstance(answer.body, str) else json.dumps(answer.body)).encode()
        self.send_response(answer.status)
        for name, value in {"Content-Type": "application/json", **answer.headers}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data[: answer.cut])
        if answer.cut is not None:
            self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing on stderr."""


class _Server(ThreadingHTTPServer):
    request_queue_size = 64


@contextlib.contextmanager
def serving() -> Iterator[LlmServer]:
    """A server on a free port, closed afterwards."""
    handler = type("Handler", (_Handler,), {})
    with _Server(("127.0.0.1", 0), handler) as http:
        http.daemon_threads = True
        llm = handler.llm = LlmServer(f"http://127.0.0.1:{http.server_address[1]}/v1")
        thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        try:
            yield llm
        finally:
            llm.closing.set()
            http.shutdown()
            thread.join()
