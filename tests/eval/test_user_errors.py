"""What people get wrong, through the real command line: one sentence that names it, and the exit status."""

from __future__ import annotations

import errno
import http.server
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.fakes import SUITE, FakeEnv, FakeWorld
from support.policy_servers import SeeingEnv, WebSocketHost, free_port, websocket_host
from typer.testing import CliRunner, Result
from vecenv_eval import runner, store
from vecenv_eval.clients.codecs import numpy_msgpack
from websockets.sync.server import ServerConnection

from vecenv import cli
from vecenv.cli import build_app
from vecenv.errors import InvalidInput, SimulationError


class SeeingWorld(FakeWorld):
    """The fake suite with cameras, for policies behind servers."""

    def make(self, suite: str, *, tasks: Any, episodes: Any, **options: Any) -> FakeEnv:
        return SeeingEnv(tasks, episodes)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeWorld:
    world = SeeingWorld()
    monkeypatch.setattr(runner, "vecenv_simulator", lambda: world.simulator)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    return world


def invoke(*arguments: str) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), list(arguments))


def evaluate(*arguments: str) -> Result:
    return invoke("eval", "--suite", SUITE, "--out", "here", *arguments)


def assert_one_sentence(done: Result, *words: str, status: int = 2) -> None:
    """The command ended on purpose, with a line on standard error that says all of this."""
    assert done.exit_code == status, done.output
    assert done.exception is None or isinstance(done.exception, SystemExit)
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert [word for word in words if word not in line] == []


# Policies.

VERBS = "    def reset(self, env, info): ...\n    def act(self, env): ...\n"
BAD_POLICIES = {
    "raises": (
        "class P:\n    name = 'p'\n    def __init__(self):\n        raise OSError('no weights in /models')\n" + VERBS,
        "P",
    ),
    "exits": ("import sys\nclass P:\n    def __init__(self):\n        sys.exit('bye')\n" + VERBS, "P"),
    "syntax": ("class P:\n    def act(self:\n", "P"),
    "imports": ("import a_package_that_is_not_there\n", "P"),
    "script": ("import sys\nsys.exit(3)\n", "P"),
    "nothing": ("X = 1\n", "P"),
    "no_policy": ("class P:\n    name = 'p'\n", "P"),
    "module": (None, "P"),
    "property": ("class P:\n    @property\n    def name(self): raise ValueError('none')\n" + VERBS, "P"),
}
SAYS = {
    "raises": ("policy 'bad_raises:P': making it failed: OSError: no weights in /models", "bad_raises.py:4)"),
    "exits": ("making it failed: SystemExit: bye", "bad_exits.py:4)"),
    "syntax": ("importing 'bad_syntax' failed: SyntaxError",),
    "imports": ("ModuleNotFoundError: No module named 'a_package_that_is_not_there'", "bad_imports.py:1)"),
    "script": ("importing 'bad_script' failed: SystemExit: 3",),
    "nothing": ("the module 'bad_nothing' has no class 'P'",),
    "no_policy": ("is not a policy: it needs a name, reset(env, info) and act(env)",),
    "module": ("importing 'bad_module' failed: ModuleNotFoundError: No module named 'bad_module'",),
    "property": ("reading its attributes failed: ValueError: none",),
}
# What only `vecenv eval` asks of a policy is left out for servers.
SERVED = {name: words for name, words in SAYS.items() if name not in ("no_policy", "property")}


def write_policy(name: str) -> str:
    source, attribute = BAD_POLICIES[name]
    if source is not None:
        Path(f"bad_{name}.py").write_text(source)
    return f"bad_{name}:{attribute}"


@pytest.mark.parametrize("name", SAYS)
def test_a_policy_that_cannot_be_made(name: str, world: FakeWorld) -> None:
    done = evaluate("--policy", write_policy(name))
    assert_one_sentence(done, *SAYS[name])
    assert not Path("here").exists()


@pytest.mark.parametrize("name", SERVED)
def test_a_policy_that_cannot_be_served(name: str, world: FakeWorld) -> None:
    done = invoke("serve-policy", write_policy(name), "--as", "openpi", "--port", "0")
    about = SERVED[name][-1] if name not in ("nothing",) else "has no attribute 'P'"
    assert_one_sentence(done, f"policy 'bad_{name}:P'", about.removeprefix(f"importing 'bad_{name}' failed: "))


def test_a_policy_for_a_video_that_cannot_be_made(world: FakeWorld) -> None:
    done = invoke("video", "--suite", "libero_goal", "--policy", write_policy("raises"))
    assert_one_sentence(done, *SAYS["raises"])


def test_a_campaign_keeps_what_was_computed_when_a_policy_cannot_be_made(
    world: FakeWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vecenv_eval import campaign

    monkeypatch.setattr(campaign, "vecenv_simulator", lambda: world.simulator)
    Path("fails_later.py").write_text(
        "from vecenv_eval.policies.scripted import ZeroPolicy\n"
        "class P(ZeroPolicy):\n"
        "    def __init__(self, seed=0):\n"
        "        super().__init__()\n"
        "        if seed == 1: raise ValueError('no such seed')\n"
    )
    done = evaluate("--policy", "fails_later:P", "--seeds", "0,1")
    assert done.exit_code == 2
    assert "ValueError: no such seed" in done.stderr.splitlines()[-1]
    assert len(Path(f"here/seed-0/{SUITE}/episodes.jsonl").read_text().splitlines()) == 20


# Policy servers.


@contextmanager
def http_server() -> Iterator[int]:
    """A web server, which knows no websockets."""

    class Quiet(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"hello")

        def log_message(self, format: str, *args: Any) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.server_address[1]
        server.shutdown()
        thread.join()


@contextmanager
def nobody() -> Iterator[int]:
    yield free_port()


@contextmanager
def greets_with(message: str | bytes) -> Iterator[int]:
    def talk(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        connection.send(message)

    with websocket_host(talk) as host:
        yield host.port


@pytest.mark.parametrize(
    ("server", "says"),
    [
        (nobody, "no connection after 2 attempts"),
        (http_server, "policy server openpi at 127.0.0.1"),
        (lambda: greets_with("Traceback:\nKeyError: 'a'"), "it reports an error: KeyError: 'a'"),
        (lambda: greets_with(b"\xc1\xff\x00"), "policy server openpi at 127.0.0.1"),
        (lambda: greets_with(numpy_msgpack.pack({"model": "x"})), "policy server openpi at 127.0.0.1"),
    ],
    ids=["down", "http", "traceback", "garbage", "leaves"],
)
def test_a_server_that_is_down_or_does_not_speak_the_protocol(
    world: FakeWorld, server: Callable[[], Any], says: str
) -> None:
    quick = {"attempts": 2, "first_wait_s": 0.001, "longest_wait_s": 0.01, "timeout_s": 10}
    arguments = [f"--policy-arg={name}={value}" for name, value in quick.items()]
    with server() as port:
        done = evaluate("--policy", "openpi", f"--policy-arg=port={port}", *arguments, "--retries", "0")
    assert done.exit_code == 1
    assert done.stderr == ""
    (cause,) = [line for line in done.stdout.splitlines() if line.startswith("error that ended episodes: ")]
    assert says in cause
    assert "PolicyServerError" in cause
    assert "vecenv eval --resume here" in done.stdout
    rows = [json.loads(line) for line in Path("here/episodes.jsonl").read_text().splitlines()]
    assert all(row["error"].startswith("PolicyServerError") for row in rows)


# Packages and devices.


@pytest.mark.parametrize(
    ("option", "module", "extra"),
    [
        ("--record", "h5py", "eval"),
        ("--video=all", "av", "render"),
        ("--record-lerobot", "pyarrow", "datasets"),
    ],
)
def test_a_package_that_an_option_needs_is_named_before_anything_runs(
    world: FakeWorld, monkeypatch: pytest.MonkeyPatch, option: str, module: str, extra: str
) -> None:
    monkeypatch.setattr(runner, "is_installed", lambda name: name != module)
    done = evaluate("--policy", "zero", option)
    assert_one_sentence(done, option.split("=")[0], f"{module} is not installed: pip install 'vecenv[{extra}]'")
    assert not Path("here").exists()


def test_a_package_that_is_missing_anywhere_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], world: FakeWorld
) -> None:
    Path("settings.yaml").write_text("suite: libero_goal\n")
    monkeypatch.setitem(sys.modules, "yaml", None)
    monkeypatch.setattr(sys, "argv", ["vecenv", "eval", "--config", "settings.yaml"])
    with pytest.raises(SystemExit) as exit:
        cli.main()
    assert exit.value.code == 1
    assert capsys.readouterr().err == "error: yaml is not installed: pip install 'vecenv[eval]'\n"


@pytest.mark.parametrize(("error", "status"), [(InvalidInput("bad\nvalue"), 2), (SimulationError("bad\nvalue"), 1)])
def test_what_is_raised_on_purpose_is_one_sentence_from_any_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception, status: int
) -> None:
    def raising() -> None:
        raise error

    monkeypatch.setattr(cli, "build_app", lambda: raising)
    with pytest.raises(SystemExit) as exit:
        cli.main()
    assert (exit.value.code, capsys.readouterr().err) == (status, "error: bad value\n")


@pytest.mark.parametrize(
    ("backend", "device", "warns"), [("warp", "cpu", True), ("warp", "gpu", False), ("native", "cpu", False)]
)
def test_warp_without_a_gpu_warns_and_runs(
    world: FakeWorld,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    backend: str,
    device: str,
    warns: bool,
) -> None:
    import jax

    runner._warn_without_gpu.cache_clear()
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    assert evaluate("--policy", "zero", "--backend", backend).exit_code == 0
    said = [message for message in caplog.messages if "no CUDA device: this runs on the CPU and is slow" in message]
    assert len(said) == warns
    runner._warn_without_gpu.cache_clear()


def test_a_file_that_cannot_be_written_is_one_sentence_from_any_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(cli, "build_app", lambda: lambda: (tmp_path / "no" / "folder").write_text(""))
    with pytest.raises(SystemExit) as exit:
        cli.main()
    assert exit.value.code == 1
    assert capsys.readouterr().err == f"error: {tmp_path}/no/folder: No such file or directory\n"


# Files.


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"suite: [libero_goal\n", "line 2"),
        (b"\xff\xfe\x00suite", "cannot be read"),
        (b"seed: 2024-99-99\n", "cannot be read"),
        (b"- a\n- b\n", "expected settings such as `suite: libero_object`"),
        (b"", "expected settings"),
        (b"suit: libero_goal\n", "unknown setting 'suit': did you mean suite"),
        (b"suite: libero_goal\nmax_steps: many\n", "max_steps"),
        (b"[" * 3000, "cannot be read"),
        (b"suite: a\nseed: 1\nsuite: b\n", "line 3 has 'suite' for the second time"),
        (b"policy_args: {a: 1, a: 2}\n", "line 1 has 'a' for the second time"),
        (None, "No such file"),
    ],
)
def test_a_settings_file_that_cannot_be_used(world: FakeWorld, content: bytes | None, says: str) -> None:
    if content is not None:
        Path("settings.yaml").write_bytes(content)
    assert_one_sentence(invoke("eval", "--suite", SUITE, "--config", "settings.yaml", "--out", "here"), says)
    assert not Path("here").exists()


def test_an_exception_without_a_message_of_its_own_is_an_error_of_its_episodes(world: FakeWorld) -> None:
    source = "class E(Exception):\n    def __str__(self): raise ValueError\n"
    source += "class P:\n    name = 'p'\n    def reset(self, env, info): ...\n    def act(self, env): raise E\n"
    Path("speechless.py").write_text(source)
    assert evaluate("--policy", "speechless:P", "--tasks", "0").exit_code == 1
    rows = [json.loads(line) for line in Path("here/episodes.jsonl").read_text().splitlines()]
    assert {row["error"] for row in rows} == {"E"}


def test_a_folder_whose_name_is_too_long(world: FakeWorld) -> None:
    done = invoke("eval", "--suite", SUITE, "--policy", "zero", "--out", "a" * 300)
    assert done.exit_code == 2
    assert "File name too long" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs a file without an end")
def test_a_settings_file_without_an_end(world: FakeWorld) -> None:
    done = invoke("eval", "--suite", SUITE, "--config", "/dev/zero", "--out", "here")
    assert_one_sentence(done, "/dev/zero cannot be read: it has more than", "bytes")


def test_a_folder_instead_of_a_settings_file(world: FakeWorld) -> None:
    assert_one_sentence(invoke("eval", "--config", ".", "--out", "here"), ". cannot be read", "Is a directory")


@pytest.mark.parametrize("command", [["report", "nowhere"], ["replay", "nowhere"], ["eval", "--resume", "nowhere"]])
def test_a_folder_that_is_not_there(world: FakeWorld, command: list[str]) -> None:
    assert_one_sentence(invoke(*command), "nowhere")


def test_a_disk_without_space_when_the_folder_is_made(world: FakeWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, *arguments: Any, **named: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "mkdir", full)
    done = evaluate("--policy", "zero")
    assert_one_sentence(done, "the results in here cannot be written: No space left on device")
    assert "--resume" not in done.stderr


FULL_DISK = """
import resource, sys
from support.fakes import SUITE, FakeWorld
from vecenv_eval import runner
runner.vecenv_simulator = lambda: FakeWorld().simulator
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
sys.argv = ["vecenv", "eval", *sys.argv[2:]]
from vecenv.cli import main
main()
"""


def in_a_process(limit: int, *arguments: str) -> subprocess.CompletedProcess[str]:
    """``vecenv eval`` where no file may grow beyond so many bytes."""
    path = os.pathsep.join(filter(None, sys.path))
    return subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(limit), *arguments],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


def test_a_file_that_cannot_grow_during_the_run_costs_no_verdict(tmp_path: Path) -> None:
    out = tmp_path / "here"
    arguments = ("--suite", SUITE, "--policy", "zero", "--num-envs", "1", "--out", str(out), "--quiet")
    done = in_a_process(6000, *arguments)
    assert (done.returncode, done.stderr) == (
        2,
        f"error: {out / 'episodes.jsonl'} cannot be written: File too large. What was computed is kept; to go on: "
        f"vecenv eval --resume {out}\n",
    )
    kept = store.ResultStore(out).done()
    assert 1 <= len(kept) < 20
    again = in_a_process(10**6, "--resume", str(out), "--quiet")
    assert again.returncode == 0, again.stderr
    rows = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    assert len({(row["task"], row["episode"]) for row in rows if not row["error"]}) == 20
