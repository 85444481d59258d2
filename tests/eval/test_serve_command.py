"""``vecenv serve`` as a process: its address, its end by signals, what is kept, and wrong arguments."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from support import streams
from vecenv_eval.store import ResultStore

COMMAND = (sys.executable, "-m", "vecenv_eval.cli.serve", "--no-open", "--port", "0")
WRITER = {"X-Writer": "first-client"}


@contextmanager
def served(repository: Path, *options: str, **environment: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A server and its address."""
    paths = os.pathsep.join(str(repository / each) for each in (".", "eval", "tests"))
    process = subprocess.Popen(
        [*COMMAND, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths, **environment},
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.search(r"http://\S+", line)
        assert found, (line, process.communicate(timeout=20))
        yield process, found[0]
    finally:
        process.kill()
        process.communicate()


def run(repository: Path, options: Sequence[str]) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join(str(repository / each) for each in (".", "eval"))
    environment = {**os.environ, "PYTHONPATH": paths}
    return subprocess.run([*COMMAND, *options], capture_output=True, text=True, timeout=100, env=environment)


def ready(url: str, *states: str, headers: dict[str, str] | None = None) -> dict[str, object]:
    """The session's state once it is one of some."""
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline:
        state = httpx.get(f"{url}/api/session", headers=headers, timeout=30).json()
        if state["state"] in states:
            return state
        time.sleep(0.1)
    raise AssertionError(state)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_server_and_keeps_what_has_ended(
    repository: Path, tmp_path: Path, number: signal.Signals
) -> None:
    options = ["--suite", "libero_object", "--episodes", "3", "--policy", "random", "--max-steps", "6"]
    with served(repository, *options, "--num-envs", "1", "--out", str(tmp_path)) as (process, url):
        ready(url, "ready")
        stream = streams.opened_at(url)
        httpx.post(f"{url}/api/panel/actions", json={"action": "step", "ticks": 10}, headers=WRITER, timeout=60)
        (shown,) = httpx.get(f"{url}/api/runs", timeout=60).json()["runs"]
        total, deadline = 0, time.monotonic() + 60
        while total == 0 and time.monotonic() < deadline:
            total = httpx.get(f"{url}/api/runs/{shown['run']}/episodes", timeout=60).json()["total"]
            time.sleep(0.1)
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
        stream.close()
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert out.endswith("stopped\n")
    (folder,) = tmp_path.iterdir()
    assert len(ResultStore.open(folder).records()) == 1
    assert (shown["folder"], total) == (str(folder), 1)
    assert json.loads((folder / "summary.json").read_text())["complete"] is False


def test_a_token_of_the_environment_is_asked_for_and_never_printed(repository: Path) -> None:
    token = "a-token-of-the-tests-0123"
    with served(repository, "--access-log", VECENV_TOKEN=token) as (process, url):
        assert httpx.get(f"{url}/api/session").status_code == 401
        assert httpx.get(f"{url}/api/session", headers={"Authorization": f"Bearer {token}"}).status_code == 200
        process.terminate()
        out, err = process.communicate(timeout=60)
    assert token not in out + err
    assert err.count("GET '/api/session'") == 2


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--suite", "libero_gaol"], "unknown suite 'libero_gaol'"),
        (["--suite", "libero_goal", "--tasks", "77"], "no task 77"),
        (["--suite", "libero_goal", "--policy", "no_such"], "unknown policy 'no_such'"),
        (["--policy", "zero"], "--suite is needed"),
        (["--suite", "libero_goal,libero_object"], "one suite"),
        (["--token-file", "/no/such/file"], "cannot be read"),
    ],
)
def test_wrong_arguments_are_one_sentence_and_status_2(repository: Path, options: list[str], text: str) -> None:
    done = run(repository, options)
    assert done.returncode == 2, done.stderr
    assert text in done.stderr
    assert done.stderr.count("\n") == 1


def test_an_address_that_cannot_be_had_is_status_1(repository: Path) -> None:
    done = run(repository, ["--host", "203.0.113.7", "--token-file", str(Path(__file__))])
    assert done.returncode == 1, done.stderr
    assert "cannot listen on 203.0.113.7" in done.stderr
