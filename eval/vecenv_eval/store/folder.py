"""The results folder: one row per episode, written as it ends, so that nothing computed is ever lost.

A folder holds ``config.json`` (what was asked, versions, machine, commit), the rows (``episodes.jsonl`` or
``episodes.sqlite``, one :class:`Record` an episode, synced to disk), ``errors.log`` (tracebacks of batches that
failed), and at the end ``summary.json`` and ``report.md``. ``demos/`` holds what was executed, where that was asked for
(``vecenv_eval.demos``).
"""

from __future__ import annotations

import json
import re
import uuid
from collections.abc import Iterable
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from vecenv_eval.episodes import Episode
from vecenv_eval.store.files import append_text, read_json, replace_text
from vecenv_eval.store.lock import HOST, LOCK, writing
from vecenv_eval.store.record import Record, StoreError
from vecenv_eval.store.rows import JSONL, Rows, rows_in

CONFIG, ERRORS, SUMMARY, REPORT = "config.json", "errors.log", "summary.json", "report.md"
DEMOS = "demos"
_LOGS = "policy_logs/*.tmp"
# Where results folders go unless something else is asked for.
RESULTS = Path("results")


class ResultStore:
    """An open results folder. Make one with :meth:`create` or :meth:`open`.

    Anybody may read a folder while one process writes to it (:meth:`writing`).
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._rows: Rows | None = None

    @classmethod
    def create(cls, folder: Path, config: dict[str, Any]) -> ResultStore:
        """Make a results folder and write its ``config.json``, with an id that no other folder has.

        Args:
            folder: where; it may exist if it is empty.
            config: content of ``config.json``. Its ``config`` says which kind of store holds the rows.

        Raises:
            StoreError: something is in the way.
        """
        cls._refuse_used(folder)
        folder.mkdir(parents=True, exist_ok=True)
        with writing(folder):
            cls._refuse_used(folder)  # by a process that was quicker
            store = cls(folder)
            store.write_config({"id": uuid.uuid4().hex, **config})
            store.rows.create()
        return store

    @staticmethod
    def _refuse_used(folder: Path) -> None:
        """Refuse a folder with something in it, but for what a process leaves that was killed while it made it."""
        ours = {LOCK, HOST, f"{CONFIG}.tmp"}
        if folder.exists() and (not folder.is_dir() or any(path.name not in ours for path in folder.iterdir())):
            raise StoreError(
                f"{folder} is already there and not empty: name another folder, or continue it with --resume"
            )

    @classmethod
    def open(cls, folder: Path) -> ResultStore:
        """Open an existing results folder and check what it holds.

        Raises:
            StoreError: it is not a results folder, or its files cannot be read.
        """
        store = cls(folder)
        if not (folder / CONFIG).is_file():
            raise StoreError(f"{folder} is not a results folder: it has no {CONFIG}")
        store.config()
        store.rows.check()
        return store

    @property
    def rows(self) -> Rows:
        """What holds the records."""
        if self._rows is None:
            config = self.config() if (self.folder / CONFIG).is_file() else {}
            settings = config.get("config")
            kind = settings.get("store", JSONL) if isinstance(settings, dict) else JSONL
            self._rows = rows_in(self.folder, kind)
        return self._rows

    def writing(self) -> AbstractContextManager[None]:
        """Be the only process that writes to the folder.

        Raises:
            StoreError: another process writes to it.
        """
        return writing(self.folder)

    def config(self) -> dict[str, Any]:
        """Content of ``config.json``."""
        try:
            return read_json(self.folder / CONFIG)
        except OSError as error:
            raise StoreError(f"{self.folder / CONFIG} cannot be read: {error.strerror}") from None

    def write_config(self, config: dict[str, Any]) -> None:
        """Replace ``config.json`` in one step."""
        replace_text(self.folder / CONFIG, json.dumps(config, indent=2) + "\n")

    def write_summary(self, summary: dict[str, Any], markdown: str) -> None:
        """Replace ``summary.json`` and ``report.md``."""
        replace_text(self.folder / SUMMARY, json.dumps(summary, indent=2) + "\n")
        replace_text(self.folder / REPORT, markdown)

    def append(self, records: Iterable[Record]) -> None:
        """Add records and wait until they are on the disk.

        Raises:
            StoreError: they cannot be written.
        """
        self.rows.append(records)

    def demos_path(self, suite: str, task: int) -> Path:
        """Where the recorded episodes of a task go: ``demos/{suite}_{task}.hdf5``."""
        return self.folder / DEMOS / f"{_file_name(suite)}_{task}.hdf5"

    def log_error(self, text: str) -> None:
        """Add a traceback to ``errors.log``."""
        append_text(self.folder / ERRORS, text.rstrip() + "\n\n")

    def tidy(self) -> None:
        """Remove what a process that was killed left of files that it was replacing; for whoever is writing."""
        for pattern in (f"{CONFIG}.tmp", f"{SUMMARY}.tmp", f"{REPORT}.tmp", f"{DEMOS}/*.tmp", f"{DEMOS}/*.new", _LOGS):
            for path in self.folder.glob(pattern):
                if path.parent == self.folder or not path.parent.is_symlink():  # else those of another folder
                    path.unlink(missing_ok=True)

    def discard(self) -> None:
        """Remove the folder if it holds no episode and nothing but what :meth:`create` puts there."""
        if self.rows.read():
            return
        self.rows.close()
        ours = {self.folder / CONFIG, self.folder / LOCK, self.folder / HOST, self.rows.path}
        if set(self.folder.iterdir()) <= ours:
            self.rows.remove()
            for path in ours:
                path.unlink(missing_ok=True)
            self.folder.rmdir()

    def records(self) -> dict[Episode, Record]:
        """The record that counts of each episode, by episode: the latest, but no error replaces a verdict.

        Raises:
            StoreError: the rows cannot be read.
        """
        return self.rows.read()

    def done(self) -> frozenset[Episode]:
        """Episodes that have a verdict; those that ended in an error are tried again."""
        return frozenset(key for key, record in self.records().items() if not record.error)

    def close(self) -> None:
        """Let go of the files; the next call opens them again."""
        if self._rows is not None:
            self._rows.close()


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
