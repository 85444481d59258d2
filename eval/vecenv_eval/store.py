"""The results folder: one line per episode, written as it ends, so that nothing computed is ever lost.

A folder holds ``config.json`` (what was asked, versions, machine, commit), ``episodes.jsonl`` (append-only, one
:class:`Record` a line, synced to disk), ``errors.log`` (tracebacks of errors that ended episodes), and at the end
``summary.json`` and ``report.md``. ``demos/`` holds what was executed, where that was asked for
(``vecenv_eval.demos``). Reading tolerates a last line that a crash cut off.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from vecenv.errors import InvalidFile
from vecenv_eval.episodes import Episode

CONFIG, EPISODES, ERRORS, SUMMARY, REPORT = "config.json", "episodes.jsonl", "errors.log", "summary.json", "report.md"
DEMOS = "demos"
# Fields of a record that may differ when an episode is run again.
CIRCUMSTANCES = frozenset({"run", "batch", "setup_s", "wall_s", "policy_s", "physics_s", "images_s"})
# Where results folders go unless something else is asked for.
RESULTS = Path("results")


class StoreError(InvalidFile):
    """A results folder cannot be made, read or resumed; the message names the file."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """One line of ``episodes.jsonl``: how one episode went.

    Attributes:
        suite, task, episode: which episode.
        instruction: its language instruction.
        success: the task was solved, in the sense of the protocol: one of the next two.
        success_first: the goal held after one of the ticks.
        success_final: the goal held after the last one.
        num_steps: control ticks executed.
        reward: sum of rewards, None when it was not finite.
        fault: why the slot was quarantined, "" when it was healthy. Such an episode counts as a failure.
        error: why the episode has no verdict (an exception while it ran), "" when it has one.
        sanitized: calls of the policy whose actions held non-finite values or values out of range.
        sanitized_first: the control tick of the first of them, None when there was none.
        run: which run on this folder, 0 for the first, one more at each resume.
        batch: which stream of episodes of that run.
        setup_s: seconds it took to place the episode (building or re-placing the environment, and reset).
        wall_s: seconds from then until this episode ended, the policy's included.
        policy_s, physics_s, images_s: its share of what its stream spent in the policy, in physics and in rendering.
        extras: what the policy reports about the episode, numbers and texts by name.
        stand_ins: a sentence for each file that was missing and what was used instead.
        parts: SIMPLER's intermediate results of the success check after the last tick, by upstream's names: true or
            false, or a number. LIBERO has none.
    """

    suite: str
    task: int
    episode: int
    instruction: str
    success: bool
    num_steps: int
    reward: float | None
    fault: str = ""
    error: str = ""
    sanitized: int = 0
    sanitized_first: int | None = None
    run: int = 0
    batch: int = 0
    setup_s: float = 0.0
    wall_s: float = 0.0
    policy_s: float = 0.0
    physics_s: float = 0.0
    images_s: float = 0.0
    extras: Mapping[str, Any] = field(default_factory=dict)
    stand_ins: tuple[str, ...] = ()
    success_first: bool = False
    success_final: bool = False
    parts: Mapping[str, bool | float] = field(default_factory=dict)

    @property
    def verdict(self) -> dict[str, Any]:
        """What belongs to the episode alone: everything but when, where and how fast it ran."""
        return {name: value for name, value in asdict(self).items() if name not in CIRCUMSTANCES}

    @property
    def key(self) -> Episode:
        """Which episode this is about."""
        return Episode(self.suite, self.task, self.episode)


class ResultStore:
    """An open results folder. Make one with :meth:`create` or :meth:`open`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def create(cls, folder: Path, config: dict[str, Any]) -> ResultStore:
        """Make a results folder and write its ``config.json``.

        Raises:
            StoreError: something is in the way.
        """
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise StoreError(
                f"{folder} is already there and not empty: name another folder, or continue it with --resume"
            )
        folder.mkdir(parents=True, exist_ok=True)
        store = cls(folder)
        store.write_config(config)
        (folder / EPISODES).touch()
        return store

    @classmethod
    def open(cls, folder: Path) -> ResultStore:
        """Open an existing results folder; a line that a crash cut off is removed.

        Raises:
            StoreError: it is not a results folder, or its files cannot be read.
        """
        store = cls(folder)
        if not (folder / CONFIG).is_file():
            raise StoreError(f"{folder} is not a results folder: it has no {CONFIG}")
        store.config()
        store._repair()
        store.records()
        return store

    def config(self) -> dict[str, Any]:
        """Content of ``config.json``."""
        path = self.folder / CONFIG
        try:
            return json.loads(path.read_text())
        except (OSError, json.JSONDecodeError) as error:
            raise StoreError(f"{path} cannot be read: {error}") from None

    def write_config(self, config: dict[str, Any]) -> None:
        """Replace ``config.json`` in one step."""
        _write(self.folder / CONFIG, json.dumps(config, indent=2) + "\n")

    def write_summary(self, summary: dict[str, Any], markdown: str) -> None:
        """Replace ``summary.json`` and ``report.md``."""
        _write(self.folder / SUMMARY, json.dumps(summary, indent=2) + "\n")
        _write(self.folder / REPORT, markdown)

    def append(self, records: Iterable[Record]) -> None:
        """Add records and wait until they are on the disk."""
        text = "".join(json.dumps(_finite(asdict(record))) + "\n" for record in records)
        _append(self.folder / EPISODES, text)

    def demos_path(self, suite: str, task: int) -> Path:
        """Where the recorded episodes of a task go: ``demos/{suite}_{task}.hdf5``."""
        return self.folder / DEMOS / f"{_file_name(suite)}_{task}.hdf5"

    def log_error(self, text: str) -> None:
        """Add a traceback to ``errors.log``."""
        _append(self.folder / ERRORS, text.rstrip() + "\n\n")

    def discard(self) -> None:
        """Remove the folder if it holds no episode and nothing but what :meth:`create` puts there."""
        ours = {self.folder / CONFIG, self.folder / EPISODES}
        if set(self.folder.iterdir()) <= ours and not (self.folder / EPISODES).stat().st_size:
            for path in ours:
                path.unlink(missing_ok=True)
            self.folder.rmdir()

    def records(self) -> dict[Episode, Record]:
        """The latest record of each episode, by episode. A cut-off last line is left out.

        Raises:
            StoreError: a line before the last cannot be read.
        """
        path = self.folder / EPISODES
        lines = path.read_text().split("\n") if path.exists() else [""]
        found: dict[Episode, Record] = {}
        for number, line in enumerate(lines[:-1], start=1):  # what follows the last newline is not a whole line
            record = _parse(line, f"{path}:{number}")
            found[record.key] = record
        return found

    def done(self) -> frozenset[Episode]:
        """Episodes that have a verdict; those that ended in an error are tried again."""
        return frozenset(key for key, record in self.records().items() if not record.error)

    def _repair(self) -> None:
        """Cut ``episodes.jsonl`` after its last newline, so that the next line begins on its own."""
        path = self.folder / EPISODES
        content = path.read_bytes() if path.exists() else b""
        if not content.endswith(b"\n"):
            with path.open("ab") as file:
                file.truncate(content.rfind(b"\n") + 1)


def default_folder(root: Path, suite: str, policy: str, now: datetime | None = None) -> Path:
    """``root/<UTC time>_<suite>_<policy>``, with a counter when that name is taken."""
    stamp = (now or datetime.now(UTC)).strftime("%Y%m%dT%H%M%SZ")
    name = "_".join([stamp, *map(_file_name, (suite, policy))])
    folder, count = root / name, 1
    while folder.exists():
        count += 1
        folder = root / f"{name}-{count}"
    return folder


def _file_name(text: str) -> str:
    return re.sub(r"[^\w.-]+", "-", text)


def _parse(line: str, where: str) -> Record:
    known = {f.name for f in fields(Record)}
    try:
        values = {key: value for key, value in json.loads(line).items() if key in known}
        # Older files have one verdict, which is both.
        both = {name: values.get(name, values["success"]) for name in ("success_first", "success_final")}
        return Record(**{**values, **both, "stand_ins": tuple(values.get("stand_ins", ()))})
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(f"{where} is not an episode: {error}") from None


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    """JSON has no NaN or infinity: they become null."""
    finite = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
    return {k: _finite(v) if isinstance(v, dict) else v for k, v in finite.items()}


def _append(path: Path, text: str) -> None:
    with path.open("a") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def _write(path: Path, text: str) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text)
    temporary.replace(path)
