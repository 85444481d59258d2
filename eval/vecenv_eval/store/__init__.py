"""Results folders: every episode's record is on the disk when the episode ends, and nothing computed is ever lost.

:class:`ResultStore` is a results folder, :class:`Record` one episode. The rows are in a text file or in a SQLite
database (``rows``, ``jsonl``, ``sqlite``); whoever reads a folder does not need to know in which.
"""

from vecenv_eval.store.folder import CONFIG, DEMOS, ERRORS, REPORT, RESULTS, SUMMARY, ResultStore, default_folder
from vecenv_eval.store.jsonl import EPISODES
from vecenv_eval.store.logs import LOGS, log_path, write_log
from vecenv_eval.store.record import CIRCUMSTANCES, Record, StoreError, StoreWriteError
from vecenv_eval.store.rows import STORES
from vecenv_eval.store.sqlite import DATABASE

__all__ = [
    "CIRCUMSTANCES",
    "CONFIG",
    "DATABASE",
    "DEMOS",
    "EPISODES",
    "ERRORS",
    "LOGS",
    "REPORT",
    "RESULTS",
    "STORES",
    "SUMMARY",
    "Record",
    "ResultStore",
    "StoreError",
    "StoreWriteError",
    "default_folder",
    "log_path",
    "write_log",
]
