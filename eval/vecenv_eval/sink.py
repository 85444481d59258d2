"""Where the episode loop puts records and what belongs to them: a results folder, or a process that keeps one.

:class:`Sink` is what ``vecenv_eval.loop`` asks for, :class:`FolderSink` the one that writes a results folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from vecenv_eval.conditions import stored_as
from vecenv_eval.config import EvalConfig
from vecenv_eval.episodes import Episode
from vecenv_eval.live import write_frame
from vecenv_eval.store import Record, ResultStore, StoreWriteError

if TYPE_CHECKING:
    from vecenv_eval.demos.schema import Recording


class Sink(Protocol):
    """Takes what the episode loop produces, as it is produced."""

    @property
    def folder(self) -> Path:
        """Where videos and datasets are written."""
        ...

    def records(self) -> dict[Episode, Record]:
        """The latest record of each episode so far."""
        ...

    def append(self, records: Sequence[Record]) -> None:
        """Keep records of episodes that have ended."""
        ...

    def add_demos(self, suite: str, task: int, instruction: str, recordings: Sequence[Recording]) -> None:
        """Keep recorded episodes of a task; called before their records are appended."""
        ...

    def log_error(self, text: str) -> None:
        """Keep a traceback."""
        ...

    def publish(self, name: str, content: bytes | None) -> None:
        """Show a process's newest frame (``vecenv_eval.live``) in place of the one before; None when it has ended."""
        ...

    def write_conditions(self, conditions: dict[str, Any]) -> None:
        """Keep what the episodes run under (``vecenv_eval.conditions``)."""
        ...


class FolderSink:
    """Writes into a results folder.

    Args:
        store: the folder.
        config: what it evaluates.
    """

    def __init__(self, store: ResultStore, config: EvalConfig) -> None:
        self._store, self._config = store, config

    @property
    def folder(self) -> Path:
        """The results folder."""
        return self._store.folder

    def records(self) -> dict[Episode, Record]:
        """The latest record of each episode in the folder."""
        return self._store.records()

    def append(self, records: Sequence[Record]) -> None:
        """Add records; returns when they are on the disk."""
        self._store.append(records)

    def add_demos(self, suite: str, task: int, instruction: str, recordings: Sequence[Recording]) -> None:
        """Add recorded episodes to the task's HDF5 file; returns when they are on the disk.

        Raises:
            StoreWriteError: they cannot be written, or what is there is damaged.
        """
        from vecenv_eval.demos.hdf5 import DemoError
        from vecenv_eval.demos.write import write_demos

        path = self._store.demos_path(suite, task)
        try:
            write_demos(path, suite, task, instruction, recordings)
        except DemoError as error:
            raise StoreWriteError(f"recordings cannot be added: {error}; move the file away") from error
        except OSError as error:
            raise StoreWriteError(f"{path} cannot be written: {error.strerror}") from error

    def log_error(self, text: str) -> None:
        """Add a traceback to ``errors.log``."""
        self._store.log_error(text)

    def publish(self, name: str, content: bytes | None) -> None:
        """Replace the process's file in ``live/``, or remove it."""
        write_frame(self._store.folder, name, content)

    def write_conditions(self, conditions: dict[str, Any]) -> None:
        """Put the conditions into ``config.json``."""
        conditions = conditions | stored_as(self._config, self._store.rows.describe())
        self._store.write_config({**self._store.config(), "conditions": conditions})
