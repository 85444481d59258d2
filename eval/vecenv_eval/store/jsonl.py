"""Records in a text file, ``episodes.jsonl``: one JSON object a line, appended and synced to the disk.

A crash can cut off the last line; it is passed over by readers and removed before the next record is written.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from vecenv_eval.episodes import Episode
from vecenv_eval.store.files import append_text
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
            text = self.path.read_text()
        except FileNotFoundError:
            return {}
        except (OSError, UnicodeDecodeError) as error:
            raise StoreError(f"{self.path} cannot be read: {error}") from None
        found: dict[Episode, Record] = {}
        for number, line in enumerate(text.split("\n")[:-1], start=1):  # what follows the last newline is no whole line
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
        """Cut the file after its last newline, so that the next line begins on its own."""
        content = self.path.read_bytes() if self.path.exists() else b""
        if not content.endswith(b"\n"):
            with self.path.open("ab") as file:
                file.truncate(content.rfind(b"\n") + 1)


def _parse(line: str, where: str) -> Record:
    try:
        return from_plain(json.loads(line))
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(f"{where} is not an episode: {error}") from None
