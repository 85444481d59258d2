"""Demonstration files in LIBERO's layout, as its own scripts write them, for tests to read, break and replay."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from vecenv.libero.tasks.suites import TaskSpec

FIXTURES = {"flat_stove_1": "-0.4 0.2 0.905", "wine_rack_1": "-0.26 -0.25 0.92", "wooden_cabinet_1": "0.03 -0.25 0.905"}


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """What upstream did: actions [T, 7], states before each of them [T, 1 + nq + nv], and the MJCF it did it in."""

    actions: np.ndarray
    states: np.ndarray
    success: bool
    model_file: str
    final_state: np.ndarray | None = None


def mjcf(fixtures: Mapping[str, str] = FIXTURES, inside: str = "") -> str:
    """The part of an MJCF of libero_goal that has the poses of fixtures: name -> position."""
    bodies = "".join(f'<body name="{name}_main" pos="{pos}"/>' for name, pos in fixtures.items())
    return f'<mujoco model="base"><worldbody><body name="floor"/>{bodies}{inside}</worldbody></mujoco>'


def some_rollout(spec: TaskSpec, ticks: int = 4, success: bool = True) -> Rollout:
    """A rollout that never happened, from the task's first start."""
    states = np.repeat(spec.init_states()[:1], ticks, axis=0)
    return Rollout(actions=np.full((ticks, 7), 0.1), states=states, success=success, model_file=mjcf())


def write(path: Path, spec: TaskSpec, rollouts: Sequence[Rollout]) -> Path:
    """A file as LIBERO's ``create_dataset.py`` leaves it, without images; ``final_state`` where a rollout has one."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        bddl = f"bddl_files/{spec.suite}/{spec.name}.bddl"
        data.attrs["bddl_file_name"] = bddl
        data.attrs["env_args"] = json.dumps({"type": 1, "bddl_file": bddl})
        data.attrs["problem_info"] = json.dumps({"language_instruction": spec.language_name})
        data.attrs["macros_image_convention"] = "opengl"
        for number, rollout in enumerate(rollouts):
            _write_demo(data.create_group(f"demo_{number}"), rollout)
        data.attrs["num_demos"] = len(rollouts)
        data.attrs["total"] = sum(len(rollout.actions) for rollout in rollouts)
    return path


def _write_demo(group: h5py.Group, rollout: Rollout) -> None:
    last = np.zeros(len(rollout.actions), np.uint8)
    last[-1] = rollout.success
    group["actions"], group["states"], group["dones"], group["rewards"] = rollout.actions, rollout.states, last, last
    group.attrs["num_samples"] = len(rollout.actions)
    group.attrs["init_state"] = rollout.states[0]
    group.attrs["model_file"] = rollout.model_file
    if rollout.final_state is not None:
        group.attrs["final_state"] = rollout.final_state


def replace(group: h5py.Group, name: str, value: npt.ArrayLike) -> None:
    """Replace a dataset of a group."""
    del group[name]
    group[name] = value
