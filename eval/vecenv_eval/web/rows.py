"""The rows of a results folder, read again and again while somebody writes them.

A folder comes in; records and sentences about what cannot be read go out. Nothing is written, locked or repaired: a
text file is read on from where the last look ended, a database in one short read transaction. A damaged row costs that
row.
"""

from __future__ import annotations

import json
import os
import sqlite3
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from vecenv.errors import InvalidFile
from vecenv_eval.episodes import Episode
from vecenv_eval.store import DATABASE, EPISODES, Record
from vecenv_eval.store.record import from_plain
from vecenv_eval.store.sqlite import COLUMNS, from_columns

# Far beyond any evaluation; what asks for more is damaged or hostile.
MOST_ROWS, MOST_LINE, MOST_NUMBER = 1_000_000, 1_000_000, 10**9
_CHUNK = 1 << 22
# Seconds that a look at a database may take.
_LONGEST_S = 5.0
# Seconds within which a writer has synced what it has written.
_SETTLES_S = 5.0


class RowReader:
    """The records in one results folder, as far as they can be read.

    Args:
        folder: the results folder; it need not have any rows yet.

    Attributes:
        records: the record that counts of each episode, in the order in which they came.
        changed: seconds since the epoch at which rows were last written, None before.
    """

    def __init__(self, folder: Path) -> None:
        self.records: dict[Episode, Record] = {}
        self.changed: float | None = None
        self._folder, self._problem = folder, ""
        self._bad, self._first_bad = 0, ""
        self._place, self._lines, self._file = 0, 0, (0, 0)
        self._seen: tuple[Any, ...] = ()
        self._seen_since, self._rows = 0.0, list[tuple[Any, ...]]()

    @property
    def problems(self) -> tuple[str, ...]:
        """A sentence for whatever could not be read."""
        rows = f"{self._first_bad}; {self._bad} row{'s' * (self._bad > 1)} passed over" if self._bad else ""
        return tuple(filter(None, (self._problem, rows)))

    def refresh(self) -> bool:
        """Read what is new; whether there was anything."""
        self._problem = ""
        try:
            found = [path for name in (EPISODES, DATABASE) if (path := regular_file(self._folder, name))]
        except UnsafePath as error:
            self._problem = str(error)
            return False
        if len(found) > 1:
            self._problem = f"{self._folder.name}: it holds {EPISODES} and {DATABASE}; neither is shown"
            return False
        try:
            return bool(found) and (self._read_on if found[0].name == EPISODES else self._read_database)(found[0])
        except (OSError, sqlite3.Error) as error:
            self._problem = f"{found[0].name} cannot be read now: {error}"
            return False

    def _add(self, read: Callable[[Any], Record], values: Any, where: str) -> None:
        try:
            record = checked(read(values))
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            self._pass_over(f"{where} is not an episode: {_reason(error)}")
            return
        if record.replaces(self.records.get(record.key)):
            self.records[record.key] = record

    def _pass_over(self, sentence: str) -> None:
        self._bad += 1
        self._first_bad = self._first_bad or sentence

    def _begin_again(self) -> None:
        self.records, self._bad, self._first_bad, self._place, self._lines = {}, 0, "", 0, 0

    # -- text --------------------------------------------------------------------------------------------------------

    def _read_on(self, path: Path) -> bool:
        """Read the lines after the last one that was read; a last line without its end may still be written."""
        with path.open("rb") as file:
            about = os.fstat(file.fileno())
            if (about.st_dev, about.st_ino) != self._file or about.st_size < self._place:
                self._begin_again()
                self._file = (about.st_dev, about.st_ino)
            if about.st_size == self._place:
                return False
            self.changed = about.st_mtime
            file.seek(self._place)
            before = self._place
            for line in _whole_lines(file):
                self._place += len(line)
                self._lines += 1
                self._take_line(line, f"{EPISODES}:{self._lines}")
        return self._place != before

    def _take_line(self, line: bytes, where: str) -> None:
        if len(self.records) >= MOST_ROWS:
            self._pass_over(f"{where} is beyond the {MOST_ROWS:,} rows that are shown")
        elif len(line) > MOST_LINE:
            self._pass_over(f"{where} is not an episode: {len(line):,} characters")
        else:
            try:
                values = json.loads(line)
            except (ValueError, RecursionError) as error:
                self._pass_over(f"{where} is not an episode: {_reason(error)}")
                return
            self._add(from_plain, values, where)

    # -- database ----------------------------------------------------------------------------------------------------

    def _read_database(self, path: Path) -> bool:
        """Read all rows if the database may have changed; rows are replaced in place, so there is no reading on.

        A row may be in the file for a while before readers see it, until the writer has synced it: a file that has just
        changed is read again.
        """
        seen, now = tuple(_stamp(path.with_name(path.name + ending)) for ending in ("", "-wal")), time.monotonic()
        if seen == self._seen and now > self._seen_since + _SETTLES_S:
            return False
        rows = _database_rows(path)
        if seen != self._seen:
            self._seen, self._seen_since = seen, now
            self.changed = max(stamp[1] for stamp in seen) / 1e9
        if rows == self._rows:
            return False
        self._begin_again()
        self._rows = rows
        for number, values in enumerate(rows, start=1):
            self._add(from_columns, values, f"row {number} of {DATABASE}")
        return True


class UnsafePath(InvalidFile):
    """A name that leads out of the folder, or is no ordinary file."""


def regular_file(folder: Path, name: str) -> Path | None:
    """An ordinary file in a folder, or below it; None when there is none.

    Raises:
        UnsafePath: it is a link that leads out of the folder, or something else than a file.
    """
    path = folder / name
    try:
        real = path.resolve(strict=True)
        mode = real.stat().st_mode
    except (OSError, RuntimeError):  # RuntimeError: links in a circle
        return None
    if not real.is_relative_to(folder.resolve()):
        raise UnsafePath(f"{name} is a link out of the folder {folder.name}, and is not read")
    if not stat.S_ISREG(mode):
        raise UnsafePath(f"{name} in {folder.name} is no ordinary file, and is not read")
    return real


def checked(record: Record) -> Record:
    """A record that the page can show.

    Raises:
        ValueError: what it says is beyond any evaluation.
    """
    if record.num_steps > MOST_NUMBER:
        raise ValueError(f"num_steps is {record.num_steps}")
    if not record.suite or len(record.suite) > 200:
        raise ValueError(f"suite is {record.suite!r:.50}")
    return record


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"it has no {error.args[0]!r}"
    return " ".join(str(error).split())[:200]


def _whole_lines(file: Any) -> Iterator[bytes]:
    """Lines with their ends; an unfinished last line is left out."""
    rest = b""
    while chunk := file.read(_CHUNK):
        *lines, rest = (rest + chunk).split(b"\n")
        yield from (line + b"\n" for line in lines)
        if len(rest) > 2 * _CHUNK:
            raise OSError(f"a line is longer than {2 * _CHUNK:,} characters; what follows is not shown")


def _stamp(path: Path) -> tuple[int, int, int]:
    try:
        about = path.stat()
    except OSError:
        return (0, 0, 0)
    return (about.st_ino, about.st_mtime_ns, about.st_size)


def _database_rows(path: Path) -> list[tuple[Any, ...]]:
    """All rows, in one read transaction that ends after some seconds whatever the file holds.

    Raises:
        sqlite3.Error: the database is damaged or busy, or has no table of episodes.
    """
    uri = path.as_uri()
    try:
        connection = sqlite3.connect(f"{uri}?mode=ro", uri=True, timeout=1.0)
        connection.execute("PRAGMA schema_version")
    except sqlite3.OperationalError:
        if path.with_name(path.name + "-wal").exists():
            raise
        connection = sqlite3.connect(f"{uri}?mode=ro&immutable=1", uri=True)
    until = time.monotonic() + _LONGEST_S
    with closing(connection):
        connection.set_progress_handler(lambda: time.monotonic() > until, 10_000)
        connection.execute("PRAGMA trusted_schema = OFF")
        connection.text_factory = lambda text: text.decode("utf-8", "replace")
        tables = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND name = 'episodes'")
        if not tables.fetchall():
            return []  # not begun
        names = ", ".join(COLUMNS)
        query = f"SELECT {names} FROM episodes ORDER BY rowid LIMIT {MOST_ROWS}"  # nosec B608 # names of COLUMNS
        return connection.execute(query).fetchall()
