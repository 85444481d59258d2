"""A server that speaks the routes of ``vecenv serve`` over episodes that are counters, for tests of the page alone.

Its images, names and delays are what a test says, so that a page meets hundreds of slots, hostile names, refusals and a
server that goes away, without a simulator.
"""

from __future__ import annotations

import asyncio
import io
import json
import math
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import fastapi
import numpy as np
from fastapi import responses, staticfiles

SUITES = {"libero_goal": ("libero", 3, 5), "libero_spatial": ("libero", 10, 50), "simpler/widowx": ("simpler", 4, 24)}
TILE = 96
POLICY = "default-src 'self'; img-src 'self' data: blob:; frame-src http://127.0.0.1:*; connect-src 'self'"


@dataclass
class World:
    """What the server shows; a test changes it while the server runs."""

    instruction: str = "put the bowl on the plate"
    budget: int = 60
    solves_at: int = 20
    ticks_per_second: float = 40.0
    planning: dict[str, Any] | None = None
    url_3d: str | None = None
    refusal: str | None = None
    token: str | None = None
    state: str = "idle"
    suite: str | None = None
    policy: str | None = None
    error: str | None = None
    slots: list[dict[str, Any]] = field(default_factory=list)
    tick: int = 0
    limit: float | None = None
    bodies: list[Any] = field(default_factory=list)
    subscriptions: list[Any] = field(default_factory=list)
    shown: list[int] = field(default_factory=list)

    def build(self, body: dict[str, Any]) -> None:
        first = int(body["episodes"].split("-")[0])
        tasks = list(range(SUITES[body["suite"]][1])) if body["tasks"] == "all" else [int(body["tasks"])]
        self.suite, self.policy, self.tick, self.state, self.error = body["suite"], body["policy"], 0, "ready", None
        self.slots = [
            self.slot(i, tasks[i % len(tasks)], first + i // len(tasks)) for i in range(body["num_slots"] or 1)
        ]

    def slot(self, index: int, task: int, episode: int) -> dict[str, Any]:
        return {
            "slot": index,
            "task": task,
            "episode": episode,
            "episode_id": f"{self.suite}/{task}/{episode}",
            "instruction": self.instruction,
            "step": 0,
            "max_steps": self.budget,
            "reward": 0.0,
            "success": False,
            "terminated": False,
            "truncated": False,
            "fault": None,
        }

    def advance(self) -> None:
        self.tick += 1
        for slot in self.slots:
            if slot["terminated"] or slot["truncated"]:
                continue
            slot["step"] += 1
            if slot["slot"] % 7 == 5 and slot["step"] == 10:
                slot.update(truncated=True, fault="the state is not finite")
            elif slot["slot"] % 3 != 1 and slot["step"] == self.solves_at + slot["slot"] % 11:
                slot.update(terminated=True, success=True, reward=1.0)
            elif slot["step"] == slot["max_steps"]:
                slot.update(truncated=True)
        if all(slot["terminated"] or slot["truncated"] for slot in self.slots):
            self.state = "finished"

    def act(self, action: str, ticks: int) -> str | None:
        if action == "play":
            self.state = "playing"
        elif action == "pause":
            self.state = "paused"
        elif action == "step":
            self.state = "paused"
            for _ in range(ticks):
                self.advance()
        elif action == "stop":
            self.state = "finished"
        else:
            self.tick, self.state = 0, "ready"
            self.slots = [self.slot(slot["slot"], slot["task"], slot["episode"]) for slot in self.slots]
        return {"play": "run_start", "reset": "episode_reset"}.get(action)

    def session(self) -> dict[str, Any]:
        ended = [slot for slot in self.slots if slot["terminated"] or slot["truncated"]]
        first = self.slots[0] if self.slots else {}
        return {
            "state": self.state,
            "suite": self.suite,
            "task": first.get("task"),
            "episode": first.get("episode"),
            "num_slots": len(self.slots),
            "slots": self.slots,
            "policy": self.policy,
            "tick": self.tick,
            "ticks_per_second": self.limit,
            "step_budget": self.budget,
            "finished": len(ended),
            "successes": sum(slot["success"] for slot in ended),
            "error": self.error,
            "fields": {"suite": self.suite, "task": first.get("task"), "episode": first.get("episode")},
            "writer": True,
            "writer_held": True,
            "url_3d": self.url_3d,
            "planning": self.planning,
            "cameras": ["agentview", "wrist"] if self.slots else [],
        }

    def history(self, slot: int) -> dict[str, Any]:
        steps = list(range(self.slots[slot]["step"]))
        return {
            "slot": slot,
            "step": steps,
            "eef_pos": [[0.1 * math.sin(i / 9), 0.002 * i, 1.0 + 0.05 * math.cos(i / 7)] for i in steps],
            "gripper": [0.04 + 0.03 * math.sin(i / 5) for i in steps],
            "reward": [0.0 for _ in steps],
        }


def picture(size: int, slot: int, tick: int) -> np.ndarray:
    """An image that differs between slots and ticks, uint8 [size, size, 3]."""
    y, x = np.mgrid[:size, :size] / size
    image = np.stack([0.35 + 0.3 * y, 0.4 + 0.2 * x, np.full_like(x, 0.45)], axis=-1)
    centre = (0.5 + 0.35 * math.cos(tick / 9 + slot), 0.5 + 0.35 * math.sin(tick / 9 + slot))
    image[(x - centre[0]) ** 2 + (y - centre[1]) ** 2 < 0.02] = (0.9, 0.75, 0.2)
    return (255 * image).astype(np.uint8)


def jpeg(image: np.ndarray) -> bytes:
    from PIL import Image

    made = io.BytesIO()
    Image.fromarray(image).save(made, "JPEG", quality=80)
    return made.getvalue()


def message(header: dict[str, Any], image: bytes) -> bytes:
    text = json.dumps(header).encode()
    return len(text).to_bytes(4, "little") + text + image


def wall(world: World, cache: dict[int, bytes]) -> bytes:
    """The mosaic; drawn for a few ticks only and then repeated, since its drawing is not what is tested."""
    count = len(world.slots)
    columns = math.ceil(math.sqrt(count))
    phase = world.tick % 8
    if phase not in cache:
        sheet = np.zeros((math.ceil(count / columns) * TILE, columns * TILE, 3), np.uint8)
        for slot in range(count):
            top, left = slot // columns * TILE, slot % columns * TILE
            sheet[top : top + TILE, left : left + TILE] = picture(TILE, slot, 8 * phase)
        cache[phase] = jpeg(sheet)
    verdicts = [
        "fault" if s["fault"] else "success" if s["success"] else "failure" if s["truncated"] else "live"
        for s in world.slots
    ]
    header = {
        "type": "wall",
        "tile": TILE,
        "columns": columns,
        "slots": list(range(count)),
        "ticks": [slot["step"] for slot in world.slots],
        "verdicts": verdicts,
    }
    return message(header, cache[phase])


def make_app(world: World) -> Any:
    """The application."""
    app = fastapi.FastAPI()
    static = str(files("vecenv_eval") / "web" / "static")
    app.mount("/static", staticfiles.StaticFiles(directory=static))

    @app.middleware("http")
    async def guard(request: fastapi.Request, call_next: Any) -> Any:
        path = request.url.path
        locked = world.token is not None and request.cookies.get("vecenv_token") != world.token
        if locked and path.startswith("/api/") and path != "/api/login":
            return responses.JSONResponse({"error": "This server needs its token."}, 401)
        if world.refusal and request.method == "POST" and path != "/api/login":
            return responses.JSONResponse({"error": world.refusal, "field": None}, 409)
        answer = await call_next(request)
        answer.headers["Content-Security-Policy"] = POLICY
        return answer

    @app.get("/")
    def page() -> Any:
        return responses.FileResponse(f"{static}/index.html")

    @app.post("/api/login")
    def login(body: dict) -> Any:
        if body["token"] != world.token:
            return responses.JSONResponse({"error": "This is not the server's token."}, 401)
        answer = responses.JSONResponse({"ok": True})
        answer.set_cookie("vecenv_token", world.token or "", httponly=True, samesite="strict")
        return answer

    @app.get("/api/catalog")
    def catalog() -> Any:
        rows = [
            {"name": n, "family": f, "num_tasks": k, "label": f"{n} ({k} tasks)"} for n, (f, k, _) in SUITES.items()
        ]
        return {"suites": rows}

    @app.get("/api/catalog/{suite:path}")
    def tasks(suite: str) -> Any:
        _, count, episodes = SUITES[suite]
        words = [f"{world.instruction}, variant {i}" for i in range(count)]
        return {
            "tasks": [{"task": i, "label": "", "instruction": w, "num_episodes": episodes} for i, w in enumerate(words)]
        }

    @app.get("/api/policies")
    def policies() -> Any:
        return {"policies": [{"name": name, "description": f"The policy {name}."} for name in ("zero", "voxposer")]}

    @app.get("/api/session")
    def session() -> Any:
        return world.session()

    @app.post("/api/session")
    def build(body: dict) -> Any:
        world.bodies.append(body)
        world.build(body)
        return world.session()

    @app.get("/api/session/history")
    def history(slot: int = 0) -> Any:
        return world.history(slot)

    @app.post("/api/session/speed")
    def speed(body: dict) -> Any:
        world.limit = body["ticks_per_second"]
        return world.session()

    @app.post("/api/panel/actions")
    def action(body: dict) -> Any:
        return {"state": world.state, "signal_name": world.act(body["action"], body.get("ticks", 1))}

    @app.post("/api/view3d")
    def view3d(body: dict) -> Any:
        world.shown.append(body["slot"])
        return {"ok": True}

    @app.delete("/api/writer")
    def release() -> Any:
        return {"ok": True}

    @app.websocket("/api/stream")
    async def stream(socket: fastapi.WebSocket) -> None:
        await socket.accept()
        wanted: dict[str, Any] = {"slot": 0, "cameras": [], "wall": False, "fps": 10, "size": 256}

        async def read() -> None:
            while True:
                asked = json.loads(await socket.receive_text())
                wanted.update(asked.get("subscribe", {}))
                world.subscriptions.append(asked)

        async def write() -> None:
            cache: dict[int, bytes] = {}
            sent: Any = None
            while True:
                state = world.session()
                now = (json.dumps(state), wanted["slot"], tuple(wanted["cameras"]), wanted["wall"])
                if now != sent:
                    sent = now
                    await socket.send_text(json.dumps({"type": "session", **state}))
                    for camera in wanted["cameras"] if world.slots else ():
                        slot = wanted["slot"]
                        tick = world.slots[slot]["step"]
                        image = jpeg(picture(128, slot + 3 * (camera == "wrist"), tick))
                        header = {
                            "type": "frame",
                            "slot": slot,
                            "camera": camera,
                            "tick": tick,
                            "width": 128,
                            "height": 128,
                        }
                        await socket.send_bytes(message(header, image))
                    if wanted["wall"] and world.slots:
                        if len(world.slots) != len(cache.get(-1, b"")):
                            cache.clear()
                            cache[-1] = bytes(len(world.slots))
                        await socket.send_bytes(wall(world, cache))
                await asyncio.sleep(1 / wanted["fps"])

        reader, writer = asyncio.create_task(read()), asyncio.create_task(write())
        await asyncio.wait([reader, writer], return_when=asyncio.FIRST_COMPLETED)
        for task in (reader, writer):
            task.cancel()
        await asyncio.gather(reader, writer, return_exceptions=True)

    return app


def free_port() -> int:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return bound.getsockname()[1]


@contextmanager
def serving(app: Any, port: int) -> Iterator[str]:
    """The address of an application that runs on a port of this machine."""
    import uvicorn

    server = uvicorn.Server(
        uvicorn.Config(app, host="127.0.0.1", port=port, log_level="error", timeout_graceful_shutdown=1)
    )
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive(), "the server did not start"
        time.sleep(0.01)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        server.should_exit = True
        thread.join(timeout=10)


@contextmanager
def playing(world: World) -> Iterator[None]:
    """The world goes on while its state is "playing"."""
    over = threading.Event()

    def run() -> None:
        while not over.wait(1 / world.ticks_per_second):
            if world.state == "playing":
                world.advance()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(timeout=10)
