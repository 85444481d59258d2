"""A server of ``vecenv view`` in a thread, and requests as a hostile client sends them."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode, urlsplit

from vecenv_eval.web.app import create_app
from vecenv_eval.web.routes_runs import runs_router
from vecenv_eval.web.runs import open_runs
from vecenv_eval.web.server import running
from vecenv_eval.web.settings import ServeSettings


class Client:
    """Requests to one server; paths go out as they are."""

    def __init__(self, url: str) -> None:
        self.url = url

    def raw(self, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body."""
        address = urlsplit(self.url)
        connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=60)
        try:
            connection.request(method, path, headers={name.replace("_", "-"): text for name, text in headers.items()})
            answer = connection.getresponse()
            return answer.status, {name.lower(): text for name, text in answer.getheaders()}, answer.read()
        finally:
            connection.close()

    def json(self, path: str, status: int = 200, **query: Any) -> Any:
        """The JSON of an answer that has this status."""
        full = f"{path}?{urlencode(query)}" if query else path
        found, _, body = self.raw(full)
        assert found == status, (full, found, body[:300])
        return json.loads(body)

    def refusal(self, path: str, status: int, **query: Any) -> str:
        """The sentence of a refusal."""
        body = self.json(path, status, **query)
        assert set(body) == {"error", "field"}
        assert "Traceback" not in body["error"]
        return body["error"]

    def image(self, path: str, **query: Any) -> tuple[int, int, tuple[int, ...]]:
        """Width, height and the middle pixel of a JPEG."""
        import io

        from PIL import Image

        status, headers, body = self.raw(f"{path}?{urlencode(query)}")
        assert (status, headers["content-type"]) == (200, "image/jpeg"), body[:300]
        picture = Image.open(io.BytesIO(body)).convert("RGB")
        pixel = picture.getpixel((picture.width // 2, picture.height // 2))
        assert isinstance(pixel, tuple)
        return picture.width, picture.height, pixel


@contextmanager
def viewing(*folders: Path, **settings: Any) -> Iterator[Client]:
    """A server of these runs."""
    app = create_app(
        None,
        ServeSettings(nodes=False, **{"requests_per_second": 1000.0, **settings}),
        routers=[runs_router(open_runs(folders))],
    )
    with running(app) as server:
        yield Client(server.url)


def address(key: str, run: str = "run") -> str:
    """The address of an episode."""
    return f"/api/runs/{quote(run)}/episodes/{quote(key)}"
