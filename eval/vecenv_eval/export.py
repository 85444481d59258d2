"""The rows of results folders as one table in a file: CSV, Parquet, JSON lines or SQLite.

A results folder comes in, or a folder of them (a campaign's); a file goes out, a row an episode, ordered by suite,
seed, task and episode. Columns are ``policy``, ``protocol``, ``seed`` (empty for the protocol's) and the fields of
``Record``, with their types; ``extras``, ``parts`` and ``stand_ins`` have no fixed form: JSON text, except in JSON
lines. CSV and Parquet need pyarrow, which is in the extra ``datasets``.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from vecenv.errors import InvalidInput, MissingDependency
from vecenv_eval.results import read_folder
from vecenv_eval.store import CONFIG, StoreError
from vecenv_eval.store.record import to_plain
from vecenv_eval.store.sqlite import COLUMNS, sqlite_values

if TYPE_CHECKING:
    import pyarrow as pa

# Every column and its type in SQLite; those of a row of the store, and what tells one folder's rows from another's.
TABLE = {"policy": "TEXT NOT NULL", "protocol": "TEXT NOT NULL", "seed": "INTEGER", **COLUMNS}
_ARROW = {"TEXT": "string", "INTEGER": "int64", "BOOLEAN": "bool", "REAL": "double", "JSON": "string"}


class ExportError(InvalidInput):
    """Rows cannot be exported to where they were asked for; the message names it."""


def export(folder: Path, kind: str, out: Path) -> int:
    """Write the rows of a results folder, or of all in a folder, to one file.

    Args:
        folder: what to export; nothing in it is changed, and a run may be writing to it.
        kind: a key of `FORMATS`.
        out: the file, which must not exist.

    Returns:
        The number of rows.

    Raises:
        ExportError: there is no such format, or the file is there already or cannot be written.
        StoreError: there are no results, or they are damaged.
        MissingDependency: pyarrow is needed and not installed.
    """
    if kind not in FORMATS:
        raise ExportError(f"format {kind!r} is not known; there are {', '.join(FORMATS)}")
    if out.exists():
        raise ExportError(f"{out} is already there: name another file with --out")
    rows = read_rows(folder)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".export-", dir=out.parent) as folder_of_its_own:
            temporary = Path(folder_of_its_own) / out.name
            FORMATS[kind](rows, temporary)
            temporary.replace(out)
    except (OSError, sqlite3.Error) as error:
        raise ExportError(f"{out} cannot be written: {error}") from None
    return len(rows)


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of a results folder, or of those in a folder, by column; ``extras`` and ``stand_ins`` as they are.

    Raises:
        StoreError: there are no results, or they are damaged.
    """
    rows = []
    for each in results_folders(folder):
        config, store = read_folder(each)
        about = {"policy": config.policy_name, "protocol": config.protocol, "seed": config.seed}
        rows += [about | to_plain(record) for record in store.records().values()]
    rows.sort(key=lambda row: (row["suite"], row["seed"] is not None, row["seed"], row["task"], row["episode"]))
    return [{name: row[name] for name in TABLE} for row in rows]


def results_folders(folder: Path) -> list[Path]:
    """A results folder itself, else those in it: one a suite, or one a seed and suite.

    Raises:
        StoreError: there is none.
    """
    if not folder.is_dir():
        raise StoreError(f"{folder} is not a results folder: there is no such folder")
    for pattern in (CONFIG, f"*/{CONFIG}", f"seed-*/*/{CONFIG}"):
        if found := sorted(path.parent for path in folder.glob(pattern)):
            return found
    raise StoreError(f"{folder} is not a results folder: neither it nor a folder in it has a {CONFIG}")


def _as_texts(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row with JSON text in the columns without a fixed form."""
    return {name: json.dumps(row[name]) if kind.startswith("JSON") else row[name] for name, kind in TABLE.items()}


def _arrow(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    try:
        import pyarrow as pa
    except ImportError:
        raise MissingDependency("CSV and Parquet need pyarrow: pip install 'vecenv[datasets]'") from None
    types = {"string": pa.string(), "int64": pa.int64(), "bool": pa.bool_(), "double": pa.float64()}
    schema = pa.schema(
        pa.field(name, types[_ARROW[kind.split()[0]]], nullable="NOT NULL" not in kind) for name, kind in TABLE.items()
    )
    return pa.Table.from_pylist([_as_texts(row) for row in rows], schema=schema)


def _write_csv(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    table = _arrow(rows)
    import pyarrow.csv

    pyarrow.csv.write_csv(table, path)


def _write_parquet(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    table = _arrow(rows)
    import pyarrow.parquet

    pyarrow.parquet.write_table(table, path)


def _write_jsonl(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def _write_sqlite(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    names = ", ".join(TABLE)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(f"CREATE TABLE episodes ({', '.join(map(' '.join, TABLE.items()))})")
        values = ", ".join(f":{name}" for name in TABLE)
        insert = f"INSERT INTO episodes ({names}) VALUES ({values})"  # nosec B608 # names of TABLE
        database.executemany(insert, map(sqlite_values, rows))


# What writes a table of rows to a file, by the name that ``vecenv export --format`` takes.
FORMATS: dict[str, Callable[[Sequence[Mapping[str, Any]], Path], None]] = {
    "csv": _write_csv,
    "parquet": _write_parquet,
    "jsonl": _write_jsonl,
    "sqlite": _write_sqlite,
}
