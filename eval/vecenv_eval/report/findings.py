"""What a reader of a run must know beside its rates: warnings, conditions, and the evidence about an episode.

A :class:`~vecenv_eval.report.run.Run` comes in; sentences, a table of conditions, and the video and the last actions of
an episode go out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vecenv_eval.report.run import Run, SuiteRun
from vecenv_eval.store import Record, ResultStore
from vecenv_eval.video.episodes import video_path

LAST_ACTIONS = 8
_SETTINGS = ("policy_args", "tasks", "episodes", "backend", "max_steps", "seed", "num_envs", "num_threads", "env_args")
_MAIN_VERSIONS = ("python", "vecenv", "mujoco", "mujoco-mjx", "warp-lang", "sapien", "jax", "numpy")


@dataclass(frozen=True, kw_only=True)
class Condition:
    """One thing that a run ran under: a value for each suite, or one that all share."""

    name: str
    values: tuple[str, ...]


def warnings(run: Run) -> list[str]:
    """What went wrong or may mislead, a sentence each."""
    return [f"{suite.suite}: {text}" for suite in run.suites for text in _suite_warnings(suite)]


def _suite_warnings(suite: SuiteRun) -> list[str]:
    total, records = suite.summary.total, suite.records
    found = []
    if total.errors:
        found.append(f"{total.errors} episodes have no verdict ({_causes(r.error for r in records)}).")
    if total.missing:
        found.append(f"{total.missing} planned episodes never ran.")
    if total.faults:
        causes = _causes(record.fault for record in records)
        found.append(f"{total.faults} episodes ended in a fault and count as failures ({causes}).")
    found += _sanitized_warning(records)
    found += [f"{count} episodes ran with a stand-in: {note}" for note, count in suite.summary.stand_ins.items()]
    if not suite.counted:
        found.append("the run has not ended, so episodes that never ran are not counted.")
    for name, what in (
        ("commit", "different commits"),
        ("versions", "different versions"),
        ("machine", "different machines"),
    ):
        if len({str(run.get(name)) for run in suite.runs}) > 1:
            found.append(f"the folder was continued with {what}.")
    if any(str(run.get("commit", "")).endswith("+changes") for run in suite.runs):
        found.append("the code differed from the commit on record.")
    return found


def _sanitized_warning(records: Iterable[Record]) -> list[str]:
    """Episodes whose policy sent actions that could not be executed as they were."""
    touched = [record for record in records if record.sanitized]
    if not touched:
        return []
    calls = sum(record.sanitized for record in touched)
    firsts = [record.sanitized_first for record in touched if record.sanitized_first is not None]
    since = f", the earliest at tick {min(firsts)}" if firsts else ""
    return [f"actions of {calls} calls in {len(touched)} episodes were not finite or out of range{since}."]


def _causes(texts: Iterable[str]) -> str:
    return "; ".join(f"{count} x {text}" for text, count in Counter(filter(None, texts)).most_common(5))


def conditions(run: Run) -> list[Condition]:
    """Everything on record that a success rate may depend on, one value for all suites where they agree."""
    tables = [_suite_conditions(suite) for suite in run.suites]
    found = []
    for name in dict.fromkeys(name for table in tables for name in table):
        values = tuple(table.get(name, "-") for table in tables)
        found.append(Condition(name=name, values=values[:1] if len(set(values)) == 1 else values))
    return found


def _suite_conditions(suite: SuiteRun) -> dict[str, str]:
    settings, named = suite.settings("config"), suite.settings("conditions")
    found = {"policy": suite.policy}
    found |= {name.replace("_", " "): plain(value) for name, value in named.items() if name != "instead"}
    if isinstance(instead := named.get("instead"), Mapping) and instead:
        changes = [
            f"{name} {' -> '.join(map(plain, pair))}" for name, pair in instead.items() if isinstance(pair, list)
        ]
        found["other than the protocol"] = ", ".join(changes)
    for name in _SETTINGS:
        label = "seed asked for" if name == "seed" else name.replace("_", " ")
        if name in settings and label not in found:
            found[label] = plain(settings[name])
    for number, run in enumerate(suite.runs, start=1):
        label = f" of run {number}" if len(suite.runs) > 1 else ""
        found[f"date{label}"] = plain(run.get("started"))
        found[f"commit{label}"] = plain(run.get("commit"))
        found[f"machine{label}"] = plain(run.get("machine"))
        found[f"versions{label}"] = plain(_main(run.get("versions")))
        found[f"command{label}"] = "vecenv " + " ".join(map(str, run.get("arguments") or ()))
    return found


def _main(versions: object) -> object:
    if not isinstance(versions, Mapping):
        return versions
    return {name: versions[name] for name in _MAIN_VERSIONS if name in versions}


def plain(value: object) -> str:
    """A setting as a reader sees it; ``-`` stands for nothing."""
    if value in (None, "", {}, [], ()):
        return "-"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {plain(each)}" for name, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(plain, value))
    return str(value)


def video_of(suite: SuiteRun, record: Record) -> Any:
    """The video of an episode; None without one."""
    path = video_path(suite.folder, record.key)
    return path if path.is_file() else None


def last_actions(suite: SuiteRun, record: Record) -> list[list[float]]:
    """The last actions that an episode executed, [at most 8, 7], oldest first; empty where none were recorded."""
    import h5py

    path = ResultStore(suite.folder).demos_path(suite.suite, record.task)
    if not path.is_file():
        return []
    try:
        with h5py.File(path, "r") as file:
            actions = file[f"data/demo_{record.episode}/actions"]
            if not isinstance(actions, h5py.Dataset) or actions.ndim != 2 or actions.shape[1] > 64:
                return []
            return np.asarray(actions[-LAST_ACTIONS:], float).round(3).tolist()
    except (OSError, KeyError, RuntimeError, ValueError, TypeError):
        return []
