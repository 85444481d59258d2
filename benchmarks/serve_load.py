"""``vecenv serve`` under readers: how fast a batch is driven with nobody, many, and hostile readers.

A server in a process of its own plays ``libero_object`` task 0 with random actions in eight slots; readers connect
from this process, each with one camera of one slot at 128 pixels and every tenth with the wall, at most five frames a
second. Hostile ones read nothing, or vanish in the middle of a frame. Meanwhile somebody asks for the state ten times a
second, which is what the latencies are of. Control ticks are counted for all slots together; CPU time is the server's.

    python benchmarks/serve_load.py [--readers 200] [--seconds 60]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
from common import ROOT, report
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

SLOTS, SIZE, FPS = 8, 128, 5.0
SERVER = (
    "-m vecenv_eval.cli.serve --no-open --port 0 --play --suite libero_object --policy random --max-steps 1000000 "
    f"--episodes {SLOTS} --num-threads 1"
).split()
MIB = 2**20


@dataclass
class Received:
    """What readers got: frames, mosaics, states, and bytes; and what went wrong."""

    frames: int = 0
    walls: int = 0
    states: int = 0
    size: int = 0
    lost: int = 0
    ticks: dict[int, int] = field(default_factory=dict)
    backwards: int = 0


async def read(url: str, number: int, got: Received, slow: bool = False) -> None:
    """One reader, until it is cancelled; a slow one reads nothing after it has asked."""
    wanted = {"slot": number % SLOTS, "cameras": ["agentview"], "size": SIZE, "fps": FPS, "wall": number % 10 == 0}
    try:
        async with connect(url, max_size=None, compression=None, max_queue=2, close_timeout=1) as stream:
            await stream.send(json.dumps({"subscribe": wanted}))
            if slow:
                await asyncio.sleep(1e9)
            async for message in stream:
                count(message, number, wanted["slot"], got)
    except (OSError, WebSocketException):
        pass
    got.lost += 1


def count(message: str | bytes, number: int, slot: int, got: Received) -> None:
    got.size += len(message)
    if isinstance(message, str):
        got.states += 1
        return
    header = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
    if header["type"] == "wall":
        got.walls += 1
        return
    got.frames += 1
    # A frame of another slot would be cross-talk; one that is older than the last, a queue.
    got.backwards += header["slot"] != slot or header["tick"] < got.ticks.get(number, 0)
    got.ticks[number] = header["tick"]


async def vanish(url: str, number: int) -> None:
    """Connects, asks, and is gone without a word in the middle of what comes, again and again."""
    while True:
        with suppress(OSError, WebSocketException):
            stream: ClientConnection = await connect(url, max_size=None, compression=None)
            await stream.send(
                json.dumps({"subscribe": {"cameras": ["agentview"], "slot": number % SLOTS, "wall": True}})
            )
            await asyncio.sleep(0.3)
            stream.transport.abort()
        await asyncio.sleep(0.7)


async def ask(address: str, latencies: list[float]) -> None:
    """Asks for the state ten times a second."""
    async with httpx.AsyncClient(base_url=address, timeout=60) as client:
        while True:
            began = time.perf_counter()
            (await client.get("/api/session")).raise_for_status()
            latencies.append(time.perf_counter() - began)
            await asyncio.sleep(0.1)


@asynccontextmanager
async def crowd(members: list[Callable[[], Any]]) -> AsyncIterator[None]:
    tasks = [asyncio.create_task(member()) for member in members]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def measure(
    name: str,
    address: str,
    server: psutil.Process,
    seconds: float,
    readers: int,
    slow: int,
    vanishing: int,
    settle: float = 5.0,
) -> dict[str, Any]:
    """One row: a phase with a crowd of readers."""
    url, got, latencies = address.replace("http", "ws", 1) + "/api/stream", Received(), []
    members: list[Callable[[], Any]] = [lambda n=n: read(url, n, got) for n in range(readers)]
    members += [lambda n=n: read(url, n, Received(), slow=True) for n in range(slow)]
    members += [lambda n=n: vanish(url, n) for n in range(vanishing)]
    async with crowd(members):
        await asyncio.sleep(settle)  # until all are connected, and those of the phase before are gone
        before = got.frames, got.walls, got.states, got.size
        async with crowd([lambda: ask(address, latencies)]), httpx.AsyncClient(base_url=address, timeout=60) as client:
            first, cpu, began = (await client.get("/api/session")).json(), sum(server.cpu_times()[:2]), time.monotonic()
            await asyncio.sleep(seconds)
            last = (await client.get("/api/session")).json()
            passed, spent = time.monotonic() - began, sum(server.cpu_times()[:2]) - cpu
        after = got.frames, got.walls, got.states, got.size
        rss, lost = server.memory_info().rss / MIB, got.lost
    steps = (last["tick"] - first["tick"]) * SLOTS
    assert last["state"] == "playing", last["error"]
    frames, walls, states, size = ((b - a) / passed for a, b in zip(before, after, strict=True))
    p50, p95, most = np.percentile(latencies, [50, 95, 100]) * 1000
    return {
        "phase": name,
        "readers": readers,
        "hostile": slow + vanishing,
        "steps/s": steps / passed,
        "steps/CPU s": steps / spent,
        "CPU %": 100 * spent / passed,
        "frames/s": frames,
        "walls/s": walls,
        "states/s": states,
        "MB/s": size / 1e6,
        "lost": lost,
        "wrong": got.backwards,
        "p50 ms": p50,
        "p95 ms": p95,
        "max ms": most,
        "RSS MiB": rss,
    }


def start(folder: Path) -> tuple[subprocess.Popen[str], str]:
    """The server, ready and playing."""
    command = [sys.executable, *SERVER, "--out", str(folder)]
    paths = os.pathsep.join(str(ROOT / each) for each in (".", "eval"))
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": paths})
    assert process.stdout is not None
    found = re.search(r"http://\S+", process.stdout.readline())
    assert found, "the server did not start"
    deadline = time.monotonic() + 300
    while httpx.get(f"{found[0]}/api/session", timeout=60).json()["state"] != "playing":
        assert time.monotonic() < deadline
        time.sleep(0.5)
    return process, found[0]


async def run(address: str, server: psutil.Process, seconds: float, readers: int) -> list[dict[str, Any]]:
    """Every phase; the first image of the scene, which takes seconds, comes before them."""
    await measure("warm-up", address, server, 1.0, 1, 0, 0)
    deadline = time.monotonic() + 200
    async with httpx.AsyncClient(base_url=address, timeout=60) as client:
        while (await client.get("/api/session")).json()["image_size"] is None:
            assert time.monotonic() < deadline
            await measure("warm-up", address, server, 1.0, 1, 0, 0)
    return [
        await measure("nobody watches", address, server, seconds / 2, 0, 0, 0),
        await measure("one reader", address, server, seconds / 2, 1, 0, 0),
        await measure("readers", address, server, seconds, readers, 0, 0),
        await measure("readers, some hostile", address, server, seconds, readers - 40, 20, 20),
        await measure("nobody again", address, server, seconds / 2, 0, 0, 0, settle=25.0),
    ]


def main() -> None:
    import tempfile

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--readers", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--name", default="serve_load", help="name of the results file")
    options = parser.parse_args()
    if options.readers < 41:
        parser.error("--readers: at least 41, of which 40 become hostile")
    with tempfile.TemporaryDirectory() as folder:
        process, address = start(Path(folder))
        try:
            load = os.getloadavg()[0]
            rows = asyncio.run(run(address, psutil.Process(process.pid), options.seconds, options.readers))
        finally:
            process.terminate()
            process.wait(60)
    notes = {"slots": SLOTS, "size": SIZE, "fps": FPS, "load average before": round(load, 1), "cores": os.cpu_count()}
    report(options.name, rows, title="vecenv serve under readers", notes=notes)


if __name__ == "__main__":
    main()
