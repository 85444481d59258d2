"""Small asset files, and a web server that serves them with faults that a test chooses."""

from __future__ import annotations

import threading
from collections import defaultdict
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

FILES = {
    "data/custom/models/can/collision.obj": b"v 0 0 0\n" * 4000,
    "data/custom/models/can/textured.dae": b"<COLLADA/>" * 3000,
    "robots/arm.urdf": b"<robot/>",
}
CAN = "data/custom/models/can/collision.obj"


def write(folder: Path, files: dict[str, bytes]) -> Path:
    for path, content in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(content)
    return folder


class Server(ThreadingHTTPServer):
    """Serves ``files``; ``tricks`` says, path by path, what to do with the next requests instead of serving."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.tricks: dict[str, list[str]] = defaultdict(list)
        self.always: dict[str, str] = {}
        self.asked: list[tuple[str, str | None]] = []
        self.over = threading.Event()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def ranges(self, path: str) -> list[str | None]:
        """The range of every request for a path."""
        return [asked for name, asked in self.asked if name == path]


class Handler(BaseHTTPRequestHandler):
    """One request."""

    protocol_version = "HTTP/1.1"
    server: Server

    def do_GET(self) -> None:
        path, begins = self.path.lstrip("/"), self.headers.get("Range")
        self.server.asked.append((path, begins))
        tricks = self.server.tricks[path]
        trick = tricks.pop(0) if tricks else self.server.always.get(path, "serve")
        if trick.startswith("redirect "):
            self._head(302, 0, Location=trick.removeprefix("redirect "))
        elif trick.startswith("status "):
            self._head(int(trick.removeprefix("status ")), 0)
        elif path not in self.server.files:
            self._head(404, 0)
        else:
            self._serve(self.server.files[path], int(begins[6:-1]) if begins else 0, trick)

    def _serve(self, content: bytes, begin: int, trick: str) -> None:
        if trick == "ignore range":
            begin = 0
        if begin >= len(content):
            return self._head(416, 0)
        rest = content[begin:]
        if trick == "corrupt":
            rest = bytes([rest[0] ^ 1]) + rest[1:]
        if trick == "too long":
            rest += b"more"
        if trick == "too short":
            rest = rest[: len(rest) // 2]
        if begin or trick == "elsewhere":
            self._head(206, len(rest), **{"Content-Range": f"bytes {7 if trick == 'elsewhere' else begin}-9/9"})
        else:
            self._head(200, len(rest))
        if trick == "drip":
            for byte in rest:
                if self.server.over.wait(0.02):
                    break
                self.wfile.write(bytes([byte]))
                self.wfile.flush()
            self.close_connection = True
        elif trick in ("truncate", "stall"):
            self.wfile.write(rest[: len(rest) // 2])
            self.wfile.flush()
            if trick == "stall":
                self.server.over.wait(10)
            self.close_connection = True
        else:
            self.wfile.write(rest)

    def _head(self, status: int, length: int, **fields: str) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(length), **fields}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Stay silent."""
