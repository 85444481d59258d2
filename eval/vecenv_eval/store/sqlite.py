"""Records in a SQLite database, ``episodes.sqlite``: one table, ``episodes``, a row an episode.

Every append is one transaction that is synced to the disk. On a local file system the database has a write-ahead log,
so that readers and the writer do not wait for one another; on any other it has SQLite's rollback journal, because the
log does not work over a network.
"""

from __future__ import annotations

import json
import logging
import shutil
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from vecenv_eval.episodes import Episode
from vecenv_eval.store.files import parse_json
from vecenv_eval.store.filesystems import file_system, is_local
from vecenv_eval.store.record import Record, StoreError, StoreWriteError, from_plain, to_plain

DATABASE = "episodes.sqlite"
# Version of the table, in the database's ``user_version``.
SCHEMA = 1
# Columns and their types, by the names of Record's fields.
COLUMNS = {
    "suite": "TEXT NOT NULL",
    "task": "INTEGER NOT NULL",
    "episode": "INTEGER NOT NULL",
    "instruction": "TEXT NOT NULL",
    "success": "BOOLEAN NOT NULL",
    "success_first": "BOOLEAN NOT NULL",
    "success_final": "BOOLEAN NOT NULL",
    "num_steps": "INTEGER NOT NULL",
    "reward": "REAL",
    "fault": "TEXT NOT NULL",
    "error": "TEXT NOT NULL",
    "sanitized": "INTEGER NOT NULL",
    "sanitized_first": "INTEGER",
    "run": "INTEGER NOT NULL",
    "batch": "INTEGER NOT NULL",
    "setup_s": "REAL NOT NULL",
    "wall_s": "REAL NOT NULL",
    "policy_s": "REAL NOT NULL",
    "physics_s": "REAL NOT NULL",
    "images_s": "REAL NOT NULL",
    "extras": "JSON NOT NULL",
    "stand_ins": "JSON NOT NULL",
    "parts": "JSON NOT NULL",
}
KEY = ("suite", "task", "episode")
# Truth values as SQLite stores them.
_FLAGS = {0: False, 1: True}
_NAMES = ", ".join(COLUMNS)
_CREATE = f"CREATE TABLE episodes ({', '.join(map(' '.join, COLUMNS.items()))}, PRIMARY KEY ({', '.join(KEY)}))"
# As Record.replaces: the latest record counts, but no error replaces a verdict.
_INSERT = (
    f"INSERT INTO episodes ({_NAMES}) VALUES ({', '.join(f':{name}' for name in COLUMNS)}) "  # nosec B608 # own names
    f"ON CONFLICT ({', '.join(KEY)}) "
    f"DO UPDATE SET {', '.join(f'{name} = excluded.{name}' for name in COLUMNS if name not in KEY)} "
    "WHERE excluded.error = '' OR episodes.error <> ''"
)
# Seconds that a reader waits for another process that holds the database, and that a writer does at a time.
_TIMEOUT_S, _WRITER_S = 30.0, 5.0
# Seconds that a writer waits in all: what it has was computed, and whoever reads will be done some time.
_PATIENCE_S = 3600.0
# Seconds for reading all rows, and bytes of one value: beyond any run's, so that a stranger's database is no trap.
_READING_S, _MOST_BYTES = 300.0, 1 << 26
# Of the names of SQLite's files.
_ENDINGS = ("", "-wal", "-shm", "-journal")
_BUSY = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
_log = logging.getLogger(__name__)


class SqliteRows:
    """The records of a results folder in ``episodes.sqlite``.

    Args:
        folder: the results folder.

    Attributes:
        path: the file.
        file_system: the type of the file system it is on.
        journal: SQLite's journal mode for it: ``"wal"``, or ``"delete"`` where the file system is not local.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / DATABASE
        self.file_system = file_system(folder)
        self.journal = "wal" if is_local(self.file_system) else "delete"
        self._connection: sqlite3.Connection | None = None

    def create(self) -> None:
        """Make the database, without records, if there is none."""
        with self._errors("written"):
            self._patiently(self._writer)

    def append(self, records: Iterable[Record]) -> None:
        """Add records in one transaction and wait until it is on the disk."""
        rows = [sqlite_values(to_plain(record)) for record in records]

        def write() -> None:
            connection = self._writer()
            with connection:
                connection.executemany(_INSERT, rows)

        with self._errors("written"):
            self._patiently(write)

    def read(self) -> dict[Episode, Record]:
        """The record of each episode, by episode, in the order in which they first came.

        Raises:
            StoreError: the database is damaged, or its table is of another version.
        """
        if not self.path.exists():
            return {}
        with self._errors("read"), closing(self._reader()) as connection:
            if not self._has_table(connection):
                return {}
            query = f"SELECT {_NAMES} FROM episodes ORDER BY rowid"  # nosec B608 # names of COLUMNS
            found = connection.execute(query).fetchall()
        records = [self._record(values) for values in found]
        return {record.key: record for record in records}

    def check(self) -> None:
        """Raise `StoreError` when the database is damaged."""
        if self.path.exists():
            with self._errors("read"), closing(self._reader()) as connection:
                (said, *_), *_ = connection.execute("PRAGMA quick_check").fetchall()
            if said != "ok":
                raise StoreError(f"{self.path} is damaged: {said.splitlines()[-1]}")
        self.read()

    def describe(self) -> str:
        """How the records are kept."""
        if self.journal == "wal":
            return "sqlite, write-ahead log"
        return f"sqlite, no write-ahead log (file system {self.file_system})"

    def notice(self) -> str:
        """What whoever starts a run should know; "" for nothing."""
        if self.journal == "wal":
            return ""
        return (
            f"{self.path.name}: SQLite's write-ahead log is off, because a file system of type {self.file_system} may "
            "be shared over a network; readers may have to wait for the writer."
        )

    def close(self) -> None:
        """Close the database, whose log becomes part of it, so that it is one file until somebody writes again."""
        connection, self._connection = self._connection, None
        if connection is None:
            return
        with self._errors("closed"), closing(connection), suppress(sqlite3.OperationalError):
            connection.execute("PRAGMA journal_mode = delete")  # not while somebody reads: then the log stays

    def remove(self) -> None:
        """Delete the database, and its log and journal."""
        self.close()
        for ending in _ENDINGS:
            self.path.with_name(self.path.name + ending).unlink(missing_ok=True)

    def _patiently(self, work: Callable[[], object]) -> None:
        """Do something again while another process has the database, of which the log speaks."""
        until = time.monotonic() + _PATIENCE_S
        while True:
            try:
                work()
                return
            except sqlite3.OperationalError as error:
                if error.sqlite_errorcode & 0xFF not in _BUSY or time.monotonic() > until:
                    raise
                _log.warning("%s: another process holds the database; waiting to write", self.path)

    def _writer(self) -> sqlite3.Connection:
        """The connection that writes, with a table to write to."""
        if self._connection is None:
            self._require_files()
            connection = sqlite3.connect(self.path, timeout=_WRITER_S, check_same_thread=False)
            try:
                self.journal = _set_journal(connection, self.journal)
                connection.execute("PRAGMA synchronous = FULL")
                with connection:
                    connection.execute("BEGIN IMMEDIATE")
                    if not self._has_table(connection):
                        connection.execute(_CREATE)
                        connection.execute(f"PRAGMA user_version = {SCHEMA}")
            except BaseException:
                connection.close()
                raise
            self._connection = connection
        return self._connection

    def _reader(self) -> sqlite3.Connection:
        """A connection that changes nothing."""
        self._require_files()
        uri = f"{self.path.resolve().as_uri()}?mode=ro"
        connection = sqlite3.connect(uri, uri=True, timeout=_TIMEOUT_S)
        try:
            connection.execute("PRAGMA schema_version")
        except sqlite3.OperationalError as error:
            connection.close()
            log = self.path.with_name(self.path.name + "-wal")
            if error.sqlite_errorcode & 0xFF in _BUSY:
                raise
            # In a folder without write permission SQLite cannot make the log's files. It needs them only if there is a
            # log, which a killed process left: then a copy is read.
            if log.exists() and log.stat().st_size:
                connection = self._reader_of_copy(log)
            else:
                connection = sqlite3.connect(f"{uri}&immutable=1", uri=True)
        return _limited(connection)

    def _require_files(self) -> None:
        """Refuse a database that SQLite would follow to another place, or wait for."""
        for ending in _ENDINGS:
            path = self.path.with_name(self.path.name + ending)
            if path.is_symlink() or (path.exists() and not path.is_file()):
                raise StoreError(f"{path} is a link or no regular file: put the database itself there")

    def _reader_of_copy(self, log: Path) -> sqlite3.Connection:
        """A connection to a copy in memory of the database and its log."""
        with TemporaryDirectory(prefix="vecenv-") as folder, self._errors("read"):
            for path in (self.path, log):
                shutil.copyfile(path, Path(folder) / path.name)
            memory = sqlite3.connect(":memory:")
            with closing(sqlite3.connect(Path(folder) / self.path.name)) as copy:
                copy.backup(memory)
        return memory

    def _has_table(self, connection: sqlite3.Connection) -> bool:
        """Whether there is the table; a database without anything in it is one that was not begun.

        Raises:
            StoreError: there is something else, or another version of it.
        """
        ((version,),) = connection.execute("PRAGMA user_version").fetchall()
        tables = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        if not tables and version == 0:
            return False
        if "episodes" not in tables:
            raise StoreError(f"{self.path} is a database without a table of episodes")
        if any(connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'")):
            raise StoreError(f"{self.path} has triggers, which could change or remove rows: it is not a run's database")
        if version != SCHEMA:
            raise StoreError(f"{self.path} has version {version} of the table of episodes; this vecenv reads {SCHEMA}")
        return True

    def _record(self, values: Sequence[Any]) -> Record:
        try:
            return from_columns(values)
        except (ValueError, TypeError) as error:
            row = dict(zip(COLUMNS, values, strict=True))
            which = "/".join(f"{row[name]!s:.50}" for name in KEY)
            raise StoreError(f"{self.path}: the row of {which} is not an episode: {error}") from None

    @contextmanager
    def _errors(self, done: str) -> Iterator[None]:
        """What SQLite raises becomes a `StoreError` that names the file."""
        try:
            yield
        except (sqlite3.Error, OSError, UnicodeDecodeError, OverflowError, MemoryError) as error:
            kind = StoreWriteError if done == "written" else StoreError
            raise kind(f"{self.path} cannot be {done}: {error}") from None


def _limited(connection: sqlite3.Connection) -> sqlite3.Connection:
    """A connection that gives up on values and statements that no run's database has."""
    until = time.monotonic() + _READING_S
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_BYTES)
    connection.set_progress_handler(lambda: time.monotonic() > until, 100_000)
    connection.execute("PRAGMA trusted_schema = OFF")
    return connection


def _set_journal(connection: sqlite3.Connection, mode: str) -> str:
    """Set the journal mode once nobody reads, for which SQLite itself does not wait; gives the mode in use."""
    deadline = time.monotonic() + _TIMEOUT_S
    while True:
        try:
            ((found,),) = connection.execute(f"PRAGMA journal_mode = {mode}").fetchall()
            return found
        except sqlite3.OperationalError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def from_columns(values: Sequence[Any]) -> Record:
    """A record from the values of its columns, in the order of ``COLUMNS``.

    Raises:
        ValueError, TypeError: they are none; the message names the field.
    """
    row = dict(zip(COLUMNS, values, strict=True))
    for name, kind in COLUMNS.items():
        if kind.startswith("BOOLEAN"):
            row[name] = _FLAGS.get(row[name])
        elif kind.startswith("JSON"):
            row[name] = parse_json(str(row[name]).encode())
    return from_plain(row)


def sqlite_values(row: Mapping[str, Any]) -> dict[str, Any]:
    """A plain row as SQLite stores it: values without a fixed form as JSON text."""
    return {name: _stored(value, COLUMNS.get(name, "")) for name, value in row.items()}


def _stored(value: Any, kind: str) -> Any:
    if kind.startswith("JSON"):
        return json.dumps(value)
    # SQLite stores UTF-8: what has no such form (a surrogate, from a file name of another encoding) is escaped.
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value
