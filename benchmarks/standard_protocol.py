"""LIBERO's standard protocol (four suites, ten tasks each, 50 episodes a task): vecenv, upstream's loop, vla-eval.

A sample of each suite is measured: its first tasks, the first episodes of each, so many ticks an episode, the same on
all sides, which take turns. No episode is solved, so all take their whole number of ticks; a side that ends one early
fails. Conditions:

*physics*: no images, a policy that answers at once (upstream only: vla-eval's LIBERO always draws).
*images*: two cameras of 256 x 256 pixels, a policy that answers at once.
*server*: the same with a policy that takes 50 ms for a call and answers all of a batch in it.

vecenv runs its harness under ``protocol="openpi"`` and draws when the policy is asked, every five ticks; its server is
``vecenv serve-policy --as openpi``, asked through the ``openpi`` client. Upstream is LIBERO's ``SubprocVectorEnv``
with a process a core, in lock step; it draws every tick, as LIBERO's and openpi's evaluations do, and its policy is
called in its process (``standard_protocol_peer.py``). vla-eval is ``vla-eval run --no-docker`` with a shard a core,
against its own server with batching, which it sends an observation every tick (``standard_protocol_vla_eval.py``).

Before each comparison every side runs one episode of one tick, not counted. Then each sample is run with two lengths of
episodes. From these follow the seconds of a tick and of the beginning of an
episode, and with the seconds that a side needs to start and to set up a task (both measured) those of the protocol:

    start + 10 tasks x set-up + 500 episodes x (beginning + horizon x tick)

with openpi's horizons. That is extrapolation: only the sample is measured. vecenv's environments count as part of the
beginnings of their episodes, and it keeps the slots of the sample, fewer than it would use.

    python benchmarks/standard_protocol.py --peer PYTHON --vla-eval PYTHON
    python benchmarks/standard_protocol.py --table      # fills the table of docs/performance.md from the results
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from common import RESULTS, ROOT, fill_table, report

from vecenv import protocols
from vecenv.contract import BatchEnv, ResetInfo
from vecenv.util.cores import usable_cores

HERE = Path(__file__).resolve().parent
SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
TASKS, EPISODES = 10, 50
PROTOCOL = protocols.protocol("openpi")
# The hand moves to and fro about its start: nothing is solved.
CHUNK = tuple(
    tuple(float(value) for value in row)
    for row in np.outer([0.5, -0.5, 0.25, -0.25, 0.0], [1, 1, 0, 0, 0, 0, 0]) + [0, 0, 0, 0, 0, 0, -1]
)


@dataclass(frozen=True, kw_only=True)
class Sample:
    """What every side runs.

    Attributes:
        suite: the suite.
        tasks, episodes: the first so many tasks, and episodes of each.
        ticks: of an episode, after ``idle`` idle ones.
        images: whether both cameras are drawn, at ``size`` pixels a side.
        reply_s: seconds that a call of the policy takes.
        server: whether the policy is behind a server where a side can do without.
        processes: of upstream and of vla-eval.
        chunk: the actions of every answer, [5, 7].
        seed: of the environments.
        started: when the side's process was started, seconds since the epoch.
    """

    suite: str
    tasks: int
    episodes: int
    ticks: int
    images: bool
    reply_s: float
    server: bool
    processes: int
    idle: int = 10
    size: int = 256
    seed: int = 7
    chunk: tuple[tuple[float, ...], ...] = CHUNK
    started: float = 0.0

    @property
    def count(self) -> int:
        """Episodes of all tasks."""
        return self.tasks * self.episodes


@dataclass(frozen=True, kw_only=True)
class Seconds:
    """What a side took: ``start_s`` until its first episode, ``setup_s`` for the environments of all tasks, ``run_s``
    for everything else.
    """

    start_s: float
    setup_s: float
    run_s: float

    @property
    def total(self) -> float:
        return self.start_s + self.setup_s + self.run_s


class Instant:
    """Answers at once with the chunk, for vecenv; looks at both cameras first where images are wanted."""

    name = "instant"

    def __init__(self, images: bool) -> None:
        self._images, self._chunk = images, np.array(CHUNK)

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        """Nothing is kept."""

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        """Nothing is kept."""

    def act(self, env: BatchEnv) -> np.ndarray:
        if self._images:
            seen = env.observe_egocentric(~env.done).images
            if black := [name for name in ("agentview", "wrist") if not seen[name].any()]:
                raise RuntimeError(f"black images of {' and '.join(black)}: {_standing(env)}")
        return np.tile(self._chunk, (env.num_envs, 1, 1))


def _standing(env: BatchEnv) -> str:
    """How many slots are live, and what failed in the others."""
    faults = Counter(env.step_continuous(np.zeros((env.num_envs, 0, 7))).info["fault"])
    told = "; ".join(f"{count} x {fault}" for fault, count in faults.items() if fault) or "none"
    return f"{int((~env.done).sum())} of {env.num_envs} slots live, faults: {told}"


class SlowChunk:
    """Served to vecenv's client: the chunk for each observation of a batch, after ``REPLY_S`` seconds a batch."""

    def act_batch(self, observations: list[Mapping[str, Any]]) -> list[np.ndarray]:
        time.sleep(float(os.environ["REPLY_S"]))
        return [np.array(CHUNK) for _ in observations]


# ---------------------------------------------------------------------------------------------------------------------
# The sides.


def run_vecenv(sample: Sample, options: argparse.Namespace) -> Seconds:
    """vecenv's harness in a process of its own, its policy in the process or behind a server."""
    with contextlib.ExitStack() as stack:
        port = stack.enter_context(_own_server(sample)) if sample.server else 0
        return _seconds([sys.executable, __file__, "--vecenv", str(port)], sample, ours=True)


def measure_vecenv(sample: Sample, port: int) -> Seconds:
    """In vecenv's process: evaluate the sample."""
    from vecenv_eval.config import EvalConfig
    from vecenv_eval.results import Progress, begin
    from vecenv_eval.runner import evaluate

    arguments: dict[str, Any] = {"images": sample.images}
    if port:
        arguments = {"port": port, "connections": sample.count, "replan_steps": len(CHUNK)}
    config = EvalConfig(
        suite=sample.suite,
        policy="openpi" if port else "standard_protocol:Instant",
        policy_args=arguments,
        tasks=f"0-{sample.tasks - 1}",
        episodes=f"0-{sample.episodes - 1}",
        protocol=PROTOCOL.name,
        max_steps=sample.ticks,
        seed=sample.seed,
    )
    marks: list[float] = []

    def mark(progress: Progress) -> None:
        marks.append(time.time())

    with tempfile.TemporaryDirectory() as folder:
        result = evaluate(config, begin(config, Path(folder) / "run"), on_progress=mark)
    ticks = [record.num_steps for record in result.records]
    if not result.ok or ticks != [sample.ticks] * sample.count:
        raise RuntimeError(f"{result.causes or ''} ticks {sorted(set(ticks))}; all sides must run {sample.ticks}")
    return Seconds(start_s=marks[0] - sample.started, setup_s=0.0, run_s=time.time() - marks[0])


def run_upstream(sample: Sample, options: argparse.Namespace) -> Seconds:
    """LIBERO's vector environment, by the peer's Python."""
    return _seconds([options.peer, str(HERE / "standard_protocol_peer.py")], sample, ours=False)


def run_vla_eval(sample: Sample, options: argparse.Namespace) -> Seconds:
    """vla-eval's runner with a shard in each process, against its own server."""
    python = Path(options.vla_eval)
    with tempfile.TemporaryDirectory() as folder, _vla_eval_server(python, sample) as port:
        config = Path(folder) / "config.yaml"
        config.write_text(json.dumps(_vla_eval_config(sample, port, folder)))  # JSON is YAML
        command = [str(python.parent / "vla-eval"), "run", "-c", str(config), "--no-docker", "--eval-id", "sample"]
        shards = [
            [*command, "--shard-id", str(i), "--num-shards", str(sample.processes)] for i in range(sample.processes)
        ]
        started = time.time()
        logs = [(Path(folder) / f"shard{i}.log").open("w+") for i in range(sample.processes)]
        workers = [
            subprocess.Popen(shard, stdout=log, stderr=subprocess.STDOUT, env=_environment(ours=False))
            for shard, log in zip(shards, logs, strict=True)
        ]
        exits = [worker.wait() for worker in workers]
        seconds = time.time() - started
        if any(exits):
            logs[0].seek(0)
            raise RuntimeError(f"vla-eval ended with {exits}:\n{logs[0].read()[-3000:]}")
        return _vla_eval_seconds(Path(folder) / "recording-sample.sqlite", sample, seconds)


def _vla_eval_config(sample: Sample, port: int, folder: str) -> dict[str, Any]:
    params = {"suite": sample.suite, "seed": sample.seed, "num_steps_wait": sample.idle}
    entry = {
        "benchmark": "vla_eval.benchmarks.libero.benchmark:LIBEROBenchmark",
        "subname": sample.suite,
        "mode": "sync",
        "episodes_per_task": sample.episodes,
        "max_tasks": sample.tasks,
        "max_steps": sample.ticks,
        "params": {**params, "send_wrist_image": True, "send_state": True},
    }
    return {"server": {"url": f"ws://127.0.0.1:{port}"}, "output_dir": folder, "benchmarks": [entry]}


def _vla_eval_seconds(path: Path, sample: Sample, total: float) -> Seconds:
    """What its records say: the first episode of a task in a shard includes the environment."""
    with contextlib.closing(sqlite3.connect(path)) as store:
        rows = store.execute(
            "select sid, task_name, elapsed_sec, steps, status, failure_detail from episode_results order by rowid"
        ).fetchall()
    if len(rows) != sample.count or {(steps, status) for *_, steps, status, _ in rows} != {(sample.ticks, "fail")}:
        raise RuntimeError(
            f"{len(rows)} episodes of vla-eval; expected {sample.count} of {sample.ticks} ticks: {rows[:1]}"
        )
    setups, runs = [], []
    for sid in {row[0] for row in rows}:
        by_task: dict[str, list[float]] = {}
        for _, task, elapsed, *_ in (row for row in rows if row[0] == sid):
            by_task.setdefault(task, []).append(elapsed)
        later = [seconds for own in by_task.values() for seconds in own[1:]]
        first = [own[0] for own in by_task.values()]
        setup = sum(max(0.0, seconds - median(later)) for seconds in first) if later else 0.0
        setups.append(setup)
        runs.append(sum(first) + sum(later) - setup)
    setup, run = max(setups), max(runs)
    return Seconds(start_s=total - setup - run, setup_s=setup, run_s=run)


SIDES: dict[str, Callable[[Sample, argparse.Namespace], Seconds]] = {
    "vecenv": run_vecenv,
    "upstream": run_upstream,
    "vla-eval": run_vla_eval,
}


def _seconds(command: list[str], sample: Sample, *, ours: bool) -> Seconds:
    """Run a side that prints its seconds as its last line."""
    asked = json.dumps(asdict(replace(sample, started=time.time())))
    environment = _environment(ours=ours)
    done = subprocess.run([*command, asked], capture_output=True, text=True, check=False, env=environment, cwd=HERE)
    if done.returncode:
        raise RuntimeError(f"{command[:2]} failed:\n{(done.stdout + done.stderr)[-3000:]}")
    return Seconds(**json.loads(done.stdout.splitlines()[-1]))


def _environment(*, ours: bool, **more: str) -> dict[str, str]:
    """The environment of a process: the same GL on all sides; this project importable in its own processes only."""
    found = {"MUJOCO_GL": "egl", **{name: value for name, value in os.environ.items() if name != "PYTHONPATH"}, **more}
    return found | ({"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "eval"), str(HERE)])} if ours else {})


@contextlib.contextmanager
def _own_server(sample: Sample) -> Iterator[int]:
    """``vecenv serve-policy`` on a free port."""
    command = [sys.executable, "-c", "from vecenv.cli import main; main()", "serve-policy"]
    command += ["standard_protocol:SlowChunk", "--as", "openpi", "--port", str(port := _free_port())]
    with _running(command, port, _environment(ours=True, REPLY_S=str(sample.reply_s))):
        yield port


@contextlib.contextmanager
def _vla_eval_server(python: Path, sample: Sample) -> Iterator[int]:
    """vla-eval's server on a free port."""
    port = _free_port()
    command = [str(python), str(HERE / "standard_protocol_vla_eval.py"), "--host", "127.0.0.1", "--port", str(port)]
    command += [f"--args.reply_s={sample.reply_s}", f"--args.most={sample.processes}"]
    with _running(command, port, _environment(ours=False, CHUNK=json.dumps(sample.chunk))):
        yield port


@contextlib.contextmanager
def _running(command: list[str], port: int, environment: dict[str, str]) -> Iterator[None]:
    """A process that accepts connections on a port; ended at the end."""
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment, cwd=HERE)
        try:
            while True:
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
                    break
                if process.poll() is not None:
                    log.seek(0)
                    raise RuntimeError(f"{command[:2]} ended:\n{log.read()[-3000:]}")
                time.sleep(0.2)
            yield
        finally:
            process.terminate()
            process.wait()


def _free_port() -> int:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return held.getsockname()[1]


# ---------------------------------------------------------------------------------------------------------------------
# Rows.


def protocol_seconds(short: Seconds, long: Seconds, sample: Sample, ticks: tuple[int, int]) -> float:
    """Seconds of a whole suite, extrapolated from a sample with two lengths of episodes; see the module."""
    tick = max(0.0, long.run_s - short.run_s) / sample.count / (ticks[1] - ticks[0])
    beginning = max(0.0, long.run_s / sample.count - ticks[1] * tick)
    start, setup = (short.start_s + long.start_s) / 2, (short.setup_s + long.setup_s) / 2
    horizon = PROTOCOL.horizon_of(sample.suite)
    assert horizon is not None
    return start + TASKS * setup / sample.tasks + TASKS * EPISODES * (beginning + horizon * tick)


def compare(suite: str, condition: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for each peer, all sides measured in turns."""
    sample = Sample(
        suite=suite,
        tasks=options.tasks,
        episodes=options.episodes,
        ticks=0,
        images=condition != "physics",
        reply_s=options.reply_ms / 1000 if condition == "server" else 0.0,
        server=condition == "server",
        processes=usable_cores(),
    )
    given = {"vecenv": True, "upstream": options.peer, "vla-eval": options.vla_eval and condition != "physics"}
    sides = [side for side in SIDES if given[side]]
    found: dict[str, list[Seconds]] = {side: [] for side in sides}
    for side in sides:  # compiled kernels and files are in caches for every side
        SIDES[side](replace(sample, tasks=1, episodes=1, ticks=1), options)
    for ticks in options.ticks:
        for side in sides:
            found[side].append(SIDES[side](replace(sample, ticks=ticks), options))
            print(f"  {suite} {condition} {ticks} ticks: {side} {found[side][-1]}", file=sys.stderr, flush=True)
    whole = {side: protocol_seconds(found[side][0], found[side][1], sample, options.ticks) for side in sides}
    return [
        {
            "suite": suite,
            "condition": condition,
            "peer": side,
            "episodes x ticks": f"{sample.count} x {options.ticks[1]}",
            "peer / vecenv, sample": round(found[side][1].total / found["vecenv"][1].total, 2),
            "peer / vecenv, protocol": round(whole[side] / whole["vecenv"], 2),
            "vecenv s, sample": round(found["vecenv"][1].total, 1),
            "peer s, sample": round(found[side][1].total, 1),
            "vecenv h, protocol": round(whole["vecenv"] / 3600, 3),
            "peer h, protocol": round(whole[side] / 3600, 3),
        }
        for side in sides
        if side != "vecenv"
    ]


def totals(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row of all suites for each condition and peer, where all four were measured."""
    made = []
    for condition, peer in dict.fromkeys((row["condition"], row["peer"]) for row in rows):
        own = [row for row in rows if (row["condition"], row["peer"]) == (condition, peer)]
        if len(own) < len(SUITES):
            continue
        sums = {name: sum(row[name] for row in own) for name in own[0] if name.split(",")[0].split()[-1] in ("s", "h")}
        ratio = {
            "peer / vecenv, sample": round(sums["peer s, sample"] / sums["vecenv s, sample"], 2),
            "peer / vecenv, protocol": round(sums["peer h, protocol"] / sums["vecenv h, protocol"], 2),
        }
        first = {"suite": "all four", "condition": condition, "peer": peer, "episodes x ticks": "sum"}
        made.append(first | ratio | {name: round(value, 3) for name, value in sums.items()})
    return made


def main() -> None:
    options = _parse()
    if options.vecenv is not None:
        print(json.dumps(asdict(measure_vecenv(Sample(**json.loads(options.sample)), options.vecenv))))
        return
    if options.table:
        print(fill_table("standard_protocol", RESULTS / f"{options.name}.json", ROOT / "docs" / "performance.md"))
        return
    if not (options.peer or options.vla_eval):
        raise SystemExit("name a side to compare with: --peer PYTHON, --vla-eval PYTHON, or both")
    rows: list[dict[str, Any]] = []
    path, kept = RESULTS / f"{options.name}.json", []
    if options.add and path.is_file():
        kept = [row for row in json.loads(path.read_text())["rows"] if row["suite"] in SUITES]
    notes = {
        "processes": usable_cores(),
        "reply_ms": options.reply_ms,
        "horizons": {suite: PROTOCOL.horizon_of(suite) for suite in SUITES},
        "extrapolated": "columns that say protocol; see the module's docstring",
    }
    for condition in options.conditions:
        for suite in options.suites:
            rows += compare(suite, condition, options)
            new = {(row["suite"], row["condition"], row["peer"]) for row in rows}
            every = [row for row in kept if (row["suite"], row["condition"], row["peer"]) not in new] + rows
            every += totals(every)  # after every comparison, so that nothing measured is lost
            report(
                options.name, every, title="LIBERO's standard protocol, a sample and what follows from it", notes=notes
            )


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--peer", metavar="PYTHON", help="upstream's Python, that of `make upstream`")
    parser.add_argument("--vla-eval", metavar="PYTHON", help="a Python with vla-eval, LIBERO and torch")
    parser.add_argument("--suites", nargs="+", choices=SUITES, default=list(SUITES))
    parser.add_argument(
        "--conditions", nargs="+", choices=("physics", "images", "server"), default=["physics", "images", "server"]
    )
    parser.add_argument("--tasks", type=int, default=2, help="tasks of each suite, the first ones")
    parser.add_argument("--episodes", type=int, default=8, help="episodes of each task, the first ones")
    parser.add_argument("--ticks", type=int, nargs=2, default=(10, 50), help="the two lengths of an episode")
    parser.add_argument("--reply-ms", type=float, default=50.0)
    parser.add_argument(
        "--add", action="store_true", help="keep the rows of the results file that are not measured now"
    )
    parser.add_argument("--name", default="standard_protocol", help="name of the results file")
    parser.add_argument("--table", action="store_true", help="fill the table of docs/performance.md, measure nothing")
    parser.add_argument("--vecenv", type=int, metavar="PORT", help=argparse.SUPPRESS)
    parser.add_argument("sample", nargs="?", help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    main()
