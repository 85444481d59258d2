"""Records in a text file, ``episodes.jsonl``: one JSON object a line, appended and synced to the disk.

A crash can cut off the last line; it is passed over by readers and removed before the next record is written.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path

from vecenv_eval.episodes import Episode
from vecenv_eval.store.files import append_text, open_regular, parse_json, read_regular
from vecenv_eval.store.record import Record, StoreError, StoreWriteError, from_plain, to_plain

EPISODES = "episodes.jsonl"


class JsonlRows:
    """The records of a results folder in ``episodes.jsonl``.

    Args:
        folder: the results folder.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / EPISODES
        self._whole = False

    def create(self) -> None:
        """Make the file, without records, if there is none."""
        append_text(self.path, "")

    def append(self, records: Iterable[Record]) -> None:
        """Add records and wait until they are on the disk.

        Raises:
            StoreError: they cannot be written.
        """
        text = "".join(json.dumps(to_plain(record)) + "\n" for record in records)
        try:
            if not self._whole:
                self._repair()
            self._whole = False  # unless all of it is written
            append_text(self.path, text)
        except OSError as error:
            raise StoreWriteError(f"{self.path} cannot be written: {error.strerror}") from None
        self._whole = True

    def read(self) -> dict[Episode, Record]:
        """The record that counts of each episode, by episode. A cut-off last line is left out.

        Raises:
            StoreError: the file cannot be read, or a line before the last is no record.
        """
        try:
            content = read_regular(self.path)
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise StoreError(f"{self.path} cannot be read: {error.strerror}") from None
        found: dict[Episode, Record] = {}
        *lines, rest = content.split(b"\n")
        for number, line in enumerate([*lines, *_whole(rest)], start=1):
            record = _parse(line, f"{self.path}:{number}")
            if record.replaces(found.get(record.key)):
                found[record.key] = record
        return found

    def check(self) -> None:
        """Raise `StoreError` when a line is damaged."""
        self.read()

    def describe(self) -> str:
        """How the records are kept."""
        return "jsonl"

    def notice(self) -> str:
        """What whoever starts a run should know: nothing."""
        return ""

    def close(self) -> None:
        """The file is closed after each record."""

    def remove(self) -> None:
        """Delete the file."""
        self.path.unlink(missing_ok=True)

    def _repair(self) -> None:
        """Make the file end with a newline: after its last record if that lacks nothing else, or by cutting it off."""
        content = read_regular(self.path) if self.path.exists() else b""
        if not content or content.endswith(b"\n"):
            return
        start = content.rfind(b"\n") + 1
        with os.fdopen(open_regular(self.path, os.O_WRONLY | os.O_APPEND), "ab") as file:
            if _whole(content[start:]):
                file.write(b"\n")
            else:
                file.truncate(start)


def _whole(rest: bytes) -> list[bytes]:
    """What follows the last newline, if it is a record of which only the newline was cut off."""
    try:
        from_plain(parse_json(rest))
    except ValueError:
        return []
    return [rest]


def _parse(line: bytes, where: str) -> Record:
    try:
        return from_plain(parse_json(line))
    except UnicodeDecodeError as error:
        raise StoreError(f"{where} is not an episode: byte {error.start + 1} is not UTF-8") from None
    except ValueError as error:
        raise StoreError(f"{where} is not an episode: {error}") from None
