"""Recordings written to HDF5 files in LIBERO's layout; SIMPLER's have no BDDL file, and the name of their task."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

import vecenv
from vecenv.libero.tasks.suites import list_suites, list_tasks
from vecenv_eval.demos.schema import Recording


def write_demos(path: Path, suite: str, task: int, instruction: str, recordings: Sequence[Recording]) -> None:
    """Add recordings to a file, or make it; an episode that is there already is replaced.

    The file is replaced in one step, so that a crash costs the recordings at hand and no earlier ones.

    Args:
        path: the file; its folder is made.
        suite, task: what is demonstrated.
        instruction: its language instruction.
        recordings: episodes of it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".tmp")
    if path.exists():
        shutil.copyfile(path, temporary)
    else:
        temporary.unlink(missing_ok=True)
    with h5py.File(temporary, "a") as file:
        data = file.require_group("data")
        _describe(data, suite, task, instruction)
        for recording in recordings:
            _write_demo(data, recording)
        data.attrs["num_demos"] = len(data)
        data.attrs["total"] = sum(int(group.attrs["num_samples"]) for group in data.values())
    with temporary.open("rb+") as file:
        os.fsync(file.fileno())
    temporary.replace(path)


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
