"""What an actor of the Ray engine is: a policy and an environment in a process of their own.

Units of episodes come in; :class:`Report` objects go out as episodes end. The episodes run in ``vecenv_eval.loop``,
whose sink here hands everything to the process that keeps the results folder; an actor writes nothing but temporary
files, so it may be on a machine that does not share the folder.
"""

from __future__ import annotations

import pickle  # nosec B403 # see its use
import queue
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import vecenv
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.episodes import Episode, Suite
from vecenv_eval.loop import EpisodeLoop, make_streams
from vecenv_eval.memory import choose_slots
from vecenv_eval.policies import Closing, Policy, PolicyUnavailable, make_policy
from vecenv_eval.results import Progress
from vecenv_eval.simulator import Simulator
from vecenv_eval.store import Record

if TYPE_CHECKING:
    from vecenv_eval.demos.schema import Recording

# Seconds between two reports of progress.
_PROGRESS_S = 0.5


@dataclass(frozen=True, kw_only=True)
class Assignment:
    """What an actor needs to know once.

    Attributes:
        config: what is evaluated, and how.
        suite: the suite.
        simulator: builds environments.
        policy_seed: seed of the policy.
        index: number of this run on the results folder.
    """

    config: EvalConfig
    suite: Suite
    simulator: Simulator
    policy_seed: int
    index: int


@dataclass(frozen=True, kw_only=True)
class ActorInfo:
    """An actor that is ready.

    Attributes:
        host: the machine it runs on.
        version: of vecenv there.
        policy: name of the policy.
    """

    host: str
    version: str
    policy: str


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """Recorded episodes of a task, as ``vecenv_eval.demos.write`` takes them."""

    suite: str
    task: int
    instruction: str
    recordings: tuple[Recording, ...]


@dataclass(frozen=True, kw_only=True)
class Report:
    """What an actor tells the driver, in the order in which it happened.

    Attributes:
        records: of episodes that have ended.
        demos: their recordings.
        files: path in the results folder -> content, of videos.
        error: a traceback for ``errors.log``.
        conditions: what the episodes run under.
        refused: why the environment refuses the config, or the policy can act in no episode.
        steps: control ticks that the actor has executed, None when that is not reported.
        live: the actor's newest frame by its name, see ``vecenv_eval.live``.
    """

    records: tuple[Record, ...] = ()
    demos: tuple[Recorded, ...] = ()
    files: Mapping[str, bytes] = field(default_factory=dict)
    error: str = ""
    conditions: Mapping[str, Any] | None = None
    refused: str = ""
    steps: int | None = None
    live: Mapping[str, bytes | None] = field(default_factory=dict)


class Outbox:
    """The sink of the episode loop in an actor: everything becomes a :class:`Report`.

    Args:
        folder: where the loop writes videos until they are reported.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.reports: queue.SimpleQueue[Report | None] = queue.SimpleQueue()
        self._demos: list[Recorded] = []
        self._live: dict[str, bytes | None] = {}

    def records(self) -> dict[Episode, Record]:
        """No record: an actor is given what has none."""
        return {}

    def append(self, records: Sequence[Record]) -> None:
        """Report records, with the recordings and videos of their episodes."""
        demos, self._demos = tuple(self._demos), []
        self.reports.put(Report(records=tuple(records), demos=demos, files=self._take_files()))

    def add_demos(self, suite: str, task: int, instruction: str, recordings: Sequence[Recording]) -> None:
        """Keep recordings until their records are appended."""
        self._demos.append(Recorded(suite=suite, task=task, instruction=instruction, recordings=tuple(recordings)))

    def log_error(self, text: str) -> None:
        """Report a traceback."""
        self.reports.put(Report(error=text))

    def publish(self, name: str, content: bytes | None) -> None:
        """Keep the newest frame until it is taken."""
        self._live[name] = content

    def take_live(self) -> dict[str, bytes | None]:
        """The newest frame, unless it was taken before."""
        taken, self._live = self._live, {}
        return taken

    def write_conditions(self, conditions: dict[str, Any]) -> None:
        """Report what the episodes run under."""
        self.reports.put(Report(conditions=conditions))

    def _take_files(self) -> dict[str, bytes]:
        """The finished files in the folder, which are removed from it; those in hidden folders are not finished."""
        taken = {}
        for path in sorted(self.folder.rglob("*")):
            name = path.relative_to(self.folder)
            if path.is_file() and not any(part.startswith(".") for part in name.parts):
                taken[name.as_posix()] = path.read_bytes()
                path.unlink()
        return taken


class EpisodeActor:
    """Runs units of episodes, in one thread from the first to the last: GL contexts belong to a thread.

    Args:
        assignment: an :class:`Assignment`, pickled: what it names is imported in :meth:`prepare`.
        path: folders in which the driver finds modules.
    """

    def __init__(self, assignment: bytes, path: Sequence[str]) -> None:
        self._pickled, self._path = assignment, path
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="episodes")
        self._scratch = tempfile.TemporaryDirectory(prefix="vecenv-actor-")
        self._outbox = Outbox(Path(self._scratch.name))
        self._stopped = threading.Event()
        self._steps, self._reported = 0, 0.0
        self._policy: Policy | None = None
        self._loop: EpisodeLoop | None = None

    def prepare(self) -> ActorInfo:
        """Make the policy. Whatever is raised says that this machine lacks something that the driver's has."""
        return self._thread.submit(self._prepare).result()

    def assign(self, assignment: bytes) -> ActorInfo:
        """Begin another run, in this process: what it has imported and compiled stays.

        Args:
            assignment: as for the constructor.
        """
        self._pickled = assignment
        return self._thread.submit(self._prepare).result()

    def run(self, number: int, episodes: Sequence[Episode]) -> Iterator[Report]:
        """Run a unit of episodes; its reports come as they happen.

        Args:
            number: what records name the unit by.
            episodes: of one scene.
        """
        running = self._thread.submit(self._run, number, episodes)
        while (report := self._outbox.reports.get()) is not None:
            yield report
        running.result()

    def close(self) -> None:
        """Stop what runs; close environment and policy."""
        self._stopped.set()
        self._thread.submit(self._close).result()
        self._thread.shutdown()
        self._scratch.cleanup()

    def _prepare(self) -> ActorInfo:
        self._close()
        self._policy, self._loop, self._steps = None, None, 0
        sys.path += [folder for folder in self._path if folder not in sys.path]
        self._given: Assignment = pickle.loads(self._pickled)  # nosec B301 # from the run that made this actor
        given = self._given
        policy = make_policy(given.config.policy_name, given.config.policy_args, seed=given.policy_seed)
        self._policy = policy
        self._loop = EpisodeLoop(
            given.config,
            given.suite,
            policy,
            given.simulator,
            self._outbox,
            planned=(),
            on_progress=self._on_progress,
            index=given.index,
        )
        return ActorInfo(host=socket.gethostname(), version=vecenv.__version__, policy=policy.name)

    def _run(self, number: int, episodes: Sequence[Episode]) -> None:
        assert self._loop is not None
        assert self._policy is not None
        by_task: dict[int, list[int]] = {}
        for episode in episodes:
            by_task.setdefault(episode.task, []).append(episode.episode)
        given, suite = self._given, self._given.suite
        try:
            most = choose_slots(given.config, suite, tuple(by_task), given.simulator).num_envs
            for stream in make_streams(self._policy, suite, list(by_task), by_task, num_envs=most):
                self._loop.run_stream(number, stream)
        except _Stopped:
            pass
        except (ConfigError, PolicyUnavailable) as error:
            self._outbox.reports.put(Report(refused=str(error)))
        finally:
            self._outbox.reports.put(Report(steps=self._steps))
            self._outbox.reports.put(None)

    def _on_progress(self, progress: Progress) -> None:
        if self._stopped.is_set():
            raise _Stopped
        self._steps, now = progress.steps, time.monotonic()
        if now - self._reported >= _PROGRESS_S:
            self._reported = now
            self._outbox.reports.put(Report(steps=self._steps, live=self._outbox.take_live()))

    def _close(self) -> None:
        if self._loop is not None:
            self._loop.close()
        if isinstance(self._policy, Closing):
            self._policy.close()


class _Stopped(BaseException):
    """Ends the episode loop from its own thread."""
