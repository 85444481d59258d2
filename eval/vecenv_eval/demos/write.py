"""Recordings written to HDF5 files in LIBERO's layout; SIMPLER's have no BDDL file, and the name of their task.

HDF5 makes a file in memory, and the file goes to the disk as a whole: a full disk is an error like any other, which the
HDF5 library does not see.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

import vecenv
from vecenv.libero.tasks.suites import list_suites, list_tasks
from vecenv_eval.demos.reader import READER
from vecenv_eval.demos.schema import Recording
from vecenv_eval.store.files import replace_bytes

# Files that this process wrote, as they were then.
_KNOWN: dict[Path, tuple[int, int, int]] = {}


def write_demos(path: Path, suite: str, task: int, instruction: str, recordings: Sequence[Recording]) -> None:
    """Add recordings to a file, or make it; an episode that is there already is replaced.

    The file is replaced in one step, so that a crash costs the recordings at hand and no earlier ones.

    Args:
        path: the file; its folder is made.
        suite, task: what is demonstrated.
        instruction: its language instruction.
        recordings: episodes of it.

    Raises:
        DemoError: there is something else, or it is damaged.
        OSError: it cannot be written; what was there still is.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _check_once(path)
    image = io.BytesIO(path.read_bytes() if path.exists() else b"")
    with h5py.File(image, "a") as file:
        data = file.require_group("data")
        _describe(data, suite, task, instruction)
        for recording in recordings:
            _write_demo(data, recording)
        data.attrs["num_demos"] = len(data)
        data.attrs["total"] = sum(int(group.attrs["num_samples"]) for group in data.values())
    replace_bytes(path, image.getvalue())
    _KNOWN[path.resolve()] = _stamp(path)


def _check_once(path: Path) -> None:
    """Have a file read by another process, unless this one wrote it: a damaged one may crash whoever opens it."""
    if path.exists() and _KNOWN.get(path.resolve()) != _stamp(path):
        READER.ask(path, "check")


def _stamp(path: Path) -> tuple[int, int, int]:
    about = path.stat()
    return about.st_ino, about.st_size, about.st_mtime_ns


def _describe(data: h5py.Group, suite: str, task: int, instruction: str) -> None:
    """The attributes that readers of LIBERO's layout look for, and ours."""
    problem: dict[str, str] = {"language_instruction": instruction}
    if suite in list_suites():
        spec = list_tasks(suite)[task]
        problem |= {"problem_name": spec.problem().name, "domain_name": "robosuite"}
        data.attrs["bddl_file_name"] = f"bddl_files/{suite}/{spec.name}.bddl"
    elif suite in vecenv.list_suites("simpler"):
        name = vecenv.list_tasks(suite)[task].name
        problem |= {"problem_name": name, "domain_name": "simpler"}
        data.attrs["task_name"] = name
    data.attrs["problem_info"] = json.dumps(problem)
    data.attrs["suite"], data.attrs["task"], data.attrs["vecenv_version"] = suite, task, vecenv.__version__


def _write_demo(data: h5py.Group, recording: Recording) -> None:
    name = f"demo_{recording.episode}"
    if name in data:
        del data[name]
    group, ticks = data.create_group(name), len(recording.actions)
    last = np.zeros(ticks, np.uint8)
    last[-1:] = 1
    group["actions"] = recording.actions
    group["dones"], group["rewards"] = last, last * np.uint8(recording.success)
    if recording.states is not None:
        group.create_dataset("states", data=recording.states, compression="gzip", compression_opts=1)
    if recording.second_half is not None:
        group["second_half"] = recording.second_half.astype(np.uint8)
    group.attrs.update(
        **recording.labels,
        num_samples=ticks,
        init_state=recording.init_state,
        final_state=recording.final_state,
        success=recording.success,
        fault=recording.fault,
        episode=recording.episode,
        make=json.dumps(recording.options),
        instruction=recording.instruction,
        stand_ins=json.dumps(recording.stand_ins),
    )
