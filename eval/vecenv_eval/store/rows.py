"""What holds the records of a results folder: the interface, and which implementation a folder has."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

from vecenv_eval.episodes import Episode
from vecenv_eval.store.jsonl import EPISODES, JsonlRows
from vecenv_eval.store.record import Record, StoreError
from vecenv_eval.store.sqlite import DATABASE, SqliteRows

# Kinds of store, by the name that ``vecenv eval --store`` takes.
STORES = {"jsonl": JsonlRows, "sqlite": SqliteRows}
JSONL = "jsonl"


class Rows(Protocol):
    """The records of one results folder, which anybody may read while one process writes.

    Attributes:
        path: the file.
    """

    path: Path

    def create(self) -> None:
        """Make the file, without records, if there is none."""
        ...

    def append(self, records: Iterable[Record]) -> None:
        """Add records, each of them whole or not at all, and wait until they are on the disk."""
        ...

    def read(self) -> dict[Episode, Record]:
        """The record that counts of each episode, by episode (see ``Record.replaces``); {} without a file."""
        ...

    def check(self) -> None:
        """Raise `StoreError` when the file is damaged; this may read all of it."""
        ...

    def describe(self) -> str:
        """How the records are kept, for ``config.json``: ``"sqlite, write-ahead log"``."""
        ...

    def notice(self) -> str:
        """A sentence for whoever starts a run, "" where there is nothing to say."""
        ...

    def close(self) -> None:
        """Let go of the file; the next call opens it again."""
        ...

    def remove(self) -> None:
        """Delete the file."""
        ...


def rows_in(folder: Path, otherwise: str = JSONL) -> Rows:
    """The records of a folder, by the file that is there.

    Args:
        folder: the results folder.
        otherwise: the kind of store where there is no file yet, a key of `STORES`.

    Raises:
        StoreError: there are two files, or no such kind.
    """
    names = {"jsonl": EPISODES, "sqlite": DATABASE}
    there = [kind for kind, name in names.items() if (folder / name).exists()]
    if len(there) > 1:
        both = " and ".join(names[kind] for kind in there)
        raise StoreError(f"{folder} holds {both}: remove or move the one that is not part of the evaluation")
    kind = there[0] if there else otherwise
    if kind not in STORES:
        raise StoreError(f"{folder}: a store of kind {kind!r:.50} is not known; there are {', '.join(STORES)}")
    return STORES[kind](folder)
