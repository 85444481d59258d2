"""Results folders as data for a page: what was planned, what has ended, how it went, while it runs and afterwards.

A folder comes in: a results folder, a campaign's, or one that holds any of these, shards of one evaluation included.
Out go immutable :class:`Snapshot` objects. Nothing is written or locked, and nothing is trusted: names are looked up
among what was found, never made into paths; links that lead out of the folder are not followed; what is damaged costs a
sentence and nothing else.
"""

from __future__ import annotations

import json
import os
import re
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

from vecenv.errors import NotFound
from vecenv_eval.conditions import describe
from vecenv_eval.config import EvalConfig, setting
from vecenv_eval.episodes import Episode
from vecenv_eval.report.summary import TOTAL, Row, summarise, wilson
from vecenv_eval.results import CAMPAIGN
from vecenv_eval.store import CONFIG, RESULTS, SUMMARY, Record, StoreError
from vecenv_eval.web.plans import Plan, planned
from vecenv_eval.web.rows import RowReader, UnsafePath, regular_file

# Folders below the one that was named: seed, suite; and shards of the submitit engine below those.
_DEPTH, _MOST_FOLDERS = 3, 500
_SHARDS = "shards"
_MOST_JSON = 4_000_000
# Seconds between two looks at the disk; looks may take a tenth of the time.
_LOOK_S, _SHARE = 0.5, 0.1
# A run whose rows or images have changed within so many seconds is said to be running.
_FRESH_S = 60.0
_LOCKS = Path("/proc/locks")


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One evaluation of a suite in a run: a results folder, or the shards of one.

    Attributes:
        name: tells it from the run's other ones, by its folder.
        folders: the results folders, that with the most first.
        suite, policy: what was evaluated.
        seed: None for the protocol's.
        config: the content of the first folder's ``config.json``.
        planned: every episode, None where that is not known.
        instructions: of each task, as far as they are known.
        records: the record that counts of each episode, in the order in which they came.
        problems: a sentence for what cannot be read.
        changed: seconds since the epoch at which rows were last written, None before.
        writing: a process of this machine writes to it.
        summarised: seconds since the epoch at which a run last ended, None before.
    """

    name: str
    folders: tuple[Path, ...]
    suite: str
    policy: str
    seed: int | None
    config: Mapping[str, Any]
    planned: frozenset[Episode] | None
    instructions: Mapping[int, str]
    records: Mapping[Episode, Record]
    problems: tuple[str, ...]
    changed: float | None
    writing: bool
    summarised: float | None

    @property
    def conditions(self) -> str:
        """What the episodes run under, as a sentence; "" where that is not known."""
        try:
            return describe(_mapping(self.config.get("conditions")))
        except (KeyError, TypeError, ValueError, AttributeError):
            return ""

    @cached_property
    def tasks(self) -> tuple[Row, ...]:
        """The numbers of each task; episodes that are planned and have not ended are missing ones."""
        by_task: dict[int, list[Record]] = {}
        for record in self.records.values():
            by_task.setdefault(record.task, []).append(record)
        wanted: dict[int, list[Episode]] = {}
        for episode in (self.planned or frozenset()) | self.records.keys():
            wanted.setdefault(episode.task, []).append(episode)
        texts = {**self.instructions, **{record.task: record.instruction for record in self.records.values()}}
        return tuple(
            summarise(
                by_task.get(task, ()), wanted[task], suite=self.suite, policy=self.policy, instructions=_ByTask(texts)
            ).tasks[0]
            for task in sorted(wanted)
        )

    @cached_property
    def total(self) -> Row:
        """All tasks pooled."""
        return pooled(self.tasks)


class _ByTask(Sequence[str]):
    """Instructions by task, "" where none is known: tasks may have any number."""

    def __init__(self, texts: Mapping[int, str]) -> None:
        self._texts = texts

    def __getitem__(self, task: Any) -> Any:
        return self._texts.get(task, "")

    def __len__(self) -> int:
        return len(self._texts)


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """A run as it was at one look.

    Attributes:
        name: of the run.
        folder: where it was read.
        legs: one a suite and seed, in the order of their folders.
        problems: a sentence for what cannot be read, those of the legs included.
        looked: seconds since the epoch.
        version: grows with every change.
    """

    name: str
    folder: Path
    legs: tuple[Leg, ...]
    problems: tuple[str, ...]
    looked: float
    version: int

    @cached_property
    def rows(self) -> Mapping[str, tuple[Leg, Record]]:
        """Every episode's leg and record by its key."""
        return {
            episode_key(leg, episode): (leg, record) for leg in self.legs for episode, record in leg.records.items()
        }

    @cached_property
    def order(self) -> Mapping[str, int]:
        """When each episode came, by its key."""
        return {key: number for number, key in enumerate(self.rows)}

    def row(self, key: str) -> tuple[Leg, Record]:
        """An episode's leg and record.

        Raises:
            NotFound: there is no such episode.
        """
        if key not in self.rows:
            raise NotFound(f"{self.name} has no episode {key!r:.100}")
        return self.rows[key]

    @cached_property
    def total(self) -> Row:
        """All episodes of all legs pooled."""
        return pooled([leg.total for leg in self.legs])

    def state(self, fresh_frames: bool = False) -> str:
        """``"running"``, ``"complete"`` (every planned episode has a verdict), ``"stopped"`` or ``"empty"``.

        Args:
            fresh_frames: a process shows images of running episodes.
        """
        known = all(leg.planned is not None for leg in self.legs)
        total = self.total
        if known and total.episodes and not (total.missing or total.errors):
            return "complete"
        now = time.time()
        if fresh_frames or any(leg.writing or _is_fresh(leg, now) for leg in self.legs):
            return "running"
        if not known and any(leg.summarised for leg in self.legs) and not (total.missing or total.errors):
            return "complete"
        return "stopped" if total.episodes or total.errors else "empty"


def _is_fresh(leg: Leg, now: float) -> bool:
    """Rows came within the last minute, after a run last ended: what runs on another machine shows in no other way."""
    return leg.changed is not None and now - leg.changed < _FRESH_S and leg.changed > (leg.summarised or 0)


def pooled(rows: Sequence[Row]) -> Row:
    """Several rows as one."""
    names = ("episodes", "successes", "first", "final", "faults", "errors", "missing")
    counts = {name: sum(getattr(row, name) for row in rows) for name in names}
    verdicts, solved = counts["episodes"], counts["successes"]
    low, high = wilson(solved, verdicts) if verdicts else (None, None)
    steps = sum((row.steps_to_solve or 0) * row.successes for row in rows)
    return Row(
        task=TOTAL,
        instruction="",
        rate=solved / verdicts if verdicts else None,
        low=low,
        high=high,
        steps_to_solve=steps / solved if solved else None,
        **counts,
    )


def episode_key(leg: Leg, episode: Episode) -> str:
    """What an episode of a run is called in addresses: letters, digits, ``-``, ``_`` and ``.``."""
    return f"{slug(leg.name)}.{slug(episode.suite)}.{episode.task}.{episode.episode}"


def slug(text: str) -> str:
    """Text without what has a meaning in an address."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", text).strip("-") or "run"


@dataclass(kw_only=True)
class _Found:
    """A results folder that was found, and its reader."""

    folder: Path
    rows: RowReader
    stamp: tuple[int, int] = (0, 0)
    config: dict[str, Any] = field(default_factory=dict)
    problem: str = ""


class RunReader:
    """One folder, looked at again and again; safe for threads.

    Args:
        name: what addresses call it.
        folder: the folder.

    Raises:
        StoreError: there is no such folder, or no results in it.
    """

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self.folder = name, folder.resolve()
        self._lock, self._due = threading.Lock(), 0.0
        self._found: dict[Path, _Found] = {}
        self._planned: dict[str, Plan | None] = {}
        self._snapshot: Snapshot | None = None
        self._signature: Any = None
        if not self.folder.is_dir():
            raise StoreError(f"{folder} is not a results folder: there is no such folder")
        if not self.snapshot().legs and not (self.folder / CAMPAIGN).is_file():
            said = "".join(f" ({problem})" for problem in self.snapshot().problems[:1])
            raise StoreError(f"{folder} is not a results folder: neither it nor a folder in it has a {CONFIG}{said}")

    def snapshot(self) -> Snapshot:
        """The run as it is, or was a moment ago."""
        with self._lock:
            if self._snapshot is None or time.monotonic() >= self._due:
                began = time.monotonic()
                self._snapshot = self._look(self._snapshot)
                now = time.monotonic()
                self._due = now + max(_LOOK_S, (now - began) / _SHARE)
            return self._snapshot

    def _look(self, before: Snapshot | None) -> Snapshot:
        problems: list[str] = []
        changed = False
        held = _locked_files()
        groups: dict[str, list[_Found]] = {}
        for folder, key in self._results_folders(problems):
            known = self._found.setdefault(folder, _Found(folder=folder, rows=RowReader(folder)))
            changed |= self._read_config(known) | known.rows.refresh()
            groups.setdefault(key or _group_of(known), []).append(known)
        legs = tuple(leg for found in groups.values() for leg in self._legs(found, held))
        problems += [problem for leg in legs for problem in leg.problems]
        signature = ([(leg.name, leg.writing, leg.summarised, leg.planned is None) for leg in legs], problems)
        if before is not None and not changed and signature == self._signature:
            return before
        self._signature = signature
        version = 1 if before is None else before.version + 1
        return Snapshot(
            name=self.name,
            folder=self.folder,
            legs=legs,
            problems=tuple(problems),
            looked=time.time(),
            version=version,
        )

    def _results_folders(self, problems: list[str]) -> Iterator[tuple[Path, str]]:
        """Results folders here and below, each with the group that it is in, "" where its config decides that."""
        waiting, seen = [(self.folder, _DEPTH)], 0
        while waiting:
            folder, depth = waiting.pop(0)
            if (folder / CONFIG).is_file():
                yield folder, str(folder)
                for shard in _folders_in(folder / _SHARDS, self.folder, problems):
                    if (shard / CONFIG).is_file():
                        yield shard, str(folder)
                continue
            inside = _folders_in(folder, self.folder, problems) if depth else []
            for each in inside:
                seen += 1
                if seen > _MOST_FOLDERS:
                    problems.append(
                        f"{self.folder.name} has more than {_MOST_FOLDERS} folders; the others are not shown"
                    )
                    return
                if (each / CONFIG).is_file():
                    yield from [(each, "")] if not (each / _SHARDS).is_dir() else []
                    waiting += [(each, 0)] if (each / _SHARDS).is_dir() else []
                else:
                    waiting.append((each, depth - 1))

    def _read_config(self, found: _Found) -> bool:
        """Read ``config.json`` if it has changed; whether it has."""
        stamp = (0, 0)
        try:
            path = regular_file(found.folder, CONFIG)
            if path is None:
                raise StoreError(f"{found.folder.name}: {CONFIG} cannot be read")
            about = path.stat()
            stamp = (about.st_mtime_ns, about.st_size)
            if stamp == found.stamp:
                return False
            found.config, found.problem = _read_json(path), ""
        except (OSError, ValueError, RecursionError, StoreError, UnsafePath) as error:
            problem = f"{found.folder.name}/{CONFIG} cannot be read: {' '.join(str(error).split())[:300]}"
            if (stamp, problem) == (found.stamp, found.problem):
                return False
            found.problem = problem
        found.stamp = stamp
        return True

    def _legs(self, found: Sequence[_Found], held: frozenset[tuple[int, int, int]]) -> list[Leg]:
        """One leg, or one a suite where rows of several are in the same folder."""
        first = found[0]
        settings = _mapping(first.config.get("config"))
        records: dict[str, dict[Episode, Record]] = {}
        for each in found:
            for episode, record in each.rows.records.items():
                of_suite = records.setdefault(episode.suite, {})
                if record.replaces(of_suite.get(episode)):
                    of_suite[episode] = record
        named, seed, policy = settings.get("suite"), settings.get("seed"), first.config.get("policy_name")
        policy = policy if isinstance(policy, str) else settings.get("policy")
        suites = list(records) or [named if isinstance(named, str) and named else "?"]
        times = [each.rows.changed for each in found if each.rows.changed is not None]
        summaries = [at for each in found if (at := _changed_at(each.folder / SUMMARY)) is not None]
        plan = self._plan([_mapping(each.config.get("config")) for each in found])
        problems = [problem for each in found for problem in (*filter(None, [each.problem]), *each.rows.problems)]
        return [
            Leg(
                name=self._label(found) + (f"/{suite}" if len(suites) > 1 else ""),
                folders=tuple(each.folder for each in found),
                suite=suite,
                policy=policy if isinstance(policy, str) and policy else "the suite's scripted one",
                seed=seed if isinstance(seed, int) else None,
                config=first.config,
                planned=None if plan is None or suite != plan.suite else plan.episodes,
                instructions={} if plan is None or suite != plan.suite else plan.instructions,
                records=records.get(suite, {}),
                problems=tuple(problems) if suite == suites[0] else (),
                changed=max(times, default=None),
                writing=any(_is_held(each.folder, held) for each in found),
                summarised=max(summaries, default=None),
            )
            for suite in suites
        ]

    def _label(self, found: Sequence[_Found]) -> str:
        names = [each.folder.relative_to(self.folder).as_posix() for each in found]
        if names[0] == ".":
            return self.folder.name
        return (
            names[0]
            if len(names) == 1 or names[1].startswith(f"{names[0]}/")
            else f"{names[0]} and {len(names) - 1} more"
        )

    def _plan(self, settings: Sequence[Mapping[str, Any]]) -> Plan | None:
        """What is planned in the folders of a leg; None where one's config says nothing that can be run here."""
        whole: Plan | None = None
        for number, each in enumerate(settings):
            if number and each.get("shard") and not settings[0].get("shard"):
                continue  # a job's share of the whole
            text = json.dumps(each, sort_keys=True, default=str)
            if text not in self._planned:
                self._planned[text] = planned(each)
            part = self._planned[text]
            if part is None:
                return None
            whole = part if whole is None else whole.joined(part)
        return whole


def _group_of(found: _Found) -> str:
    """What shards of one evaluation, beside one another, have in common; of anything else its folder."""
    settings = _mapping(found.config.get("config"))
    if not settings.get("shard"):
        return str(found.folder)
    names = [each.name for each in fields(EvalConfig) if setting(each).decides]
    decisive = {name: settings.get(name) for name in names}
    return f"{found.folder.parent}\n{json.dumps(decisive, sort_keys=True, default=str)}"


def _folders_in(folder: Path, root: Path, problems: list[str]) -> list[Path]:
    """The folders in a folder, by name; hidden ones and links are left out, links to elsewhere with a sentence."""
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if entry.is_dir() and not entry.name.startswith("."))
    except OSError:
        return []
    found = []
    for name in names:
        path = folder / name
        if not path.is_symlink():
            found.append(path)
        elif not path.resolve().is_relative_to(root):
            problems.append(f"{path.relative_to(root).as_posix()} is a link out of the folder, and is not read")
    return found


def _read_json(path: Path) -> dict[str, Any]:
    """A JSON object of a reasonable size.

    Raises:
        OSError, ValueError: it is none.
    """
    if path.stat().st_size > _MOST_JSON:
        raise ValueError(f"it is longer than {_MOST_JSON:,} characters")
    value = json.loads(path.read_bytes())
    if not isinstance(value, dict):
        raise ValueError("it holds no JSON object")
    return value


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _changed_at(path: Path) -> float | None:
    try:
        return path.stat().st_mtime
    except OSError:
        return None


def _locked_files() -> frozenset[tuple[int, int, int]]:
    """Device (major, minor) and inode of every file with a write lock on this machine.

    The lock of a results folder cannot be asked about by opening it: closing it again would end a lock that this very
    process holds.
    """
    try:
        lines = _LOCKS.read_text().splitlines()
    except OSError:
        return frozenset()
    found = set()
    for parts in map(str.split, lines):
        if len(parts) >= 6 and parts[1] == "POSIX" and parts[3] == "WRITE" and parts[5].count(":") == 2:
            major, minor, inode = parts[5].split(":")
            found.add((int(major, 16), int(minor, 16), int(inode)))
    return frozenset(found)


def _is_held(folder: Path, held: frozenset[tuple[int, int, int]]) -> bool:
    """Whether a process of this machine writes to a results folder."""
    try:
        about = (folder / ".lock").stat()
    except OSError:
        return False
    return (os.major(about.st_dev), os.minor(about.st_dev), about.st_ino) in held


def open_runs(paths: Sequence[Path]) -> list[RunReader]:
    """The runs that somebody names: folders, or names of folders in ``results``.

    Raises:
        StoreError: there are no results.
    """
    readers: list[RunReader] = []
    for path in paths:
        folder = RESULTS / path if not path.exists() and (RESULTS / path).is_dir() else path
        name, taken = slug(folder.resolve().name), {reader.name for reader in readers}
        numbered = (name if number == 1 else f"{name}-{number}" for number in count(1))
        readers.append(RunReader(next(each for each in numbered if each not in taken), folder))
    return readers
