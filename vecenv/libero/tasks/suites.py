"""LIBERO's task suites: which tasks exist, in which order, with which instruction, task file and 50 start states.

Five suites are LIBERO's own, sixteen are LIBERO-PRO's perturbations of four of them. Names and order come from the
installed task map, read as a syntax tree; task files and start states are read from disk on access, so listing is
cheap and a damaged file matters only to those who read it. Nothing is imported from `libero` or `robosuite`, nothing is
unpickled.
"""

from __future__ import annotations

import ast
import difflib
import functools
import operator
import re
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import SupportsIndex

import numpy as np

from vecenv.assets import libero_root
from vecenv.errors import InvalidFile, NotFound
from vecenv.libero.scene.bddl import Problem, load_problem

BASE_SUITES: tuple[str, ...] = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")
"""LIBERO's own suites: 10, 10, 10, 10 and 90 tasks."""
PRO_SUITES: tuple[str, ...] = tuple(
    f"libero_{base}_{perturbation}"
    for base in ("spatial", "object", "goal", "10")
    for perturbation in ("lan", "object", "swap", "task")
)
"""LIBERO-PRO's suites of 10 tasks: reworded instructions, other objects, swapped positions, other goals."""
NUM_EPISODES = 50
"""Start states of every task."""

# A start state is [time, qpos, qvel]. The arm has 7 joints and the gripper 2, an object is one free joint
# (7 positions, 6 velocities); what remains are the hinges and slides of fixtures, one position and one velocity each.
_ROBOT_COLUMNS = 2 * (7 + 2)
_OBJECT_COLUMNS = 7 + 6

_TASK_MAP_NAME = "libero_task_map"
# "KITCHEN_SCENE10_close_..." -> the instruction starts after the scene's number.
_SCENE_PREFIX = re.compile(r"^[A-Z].*?SCENE\d+_")


class UnknownSuite(NotFound, KeyError):
    """No suite has this name; the message lists those that exist and the nearest one."""

    def __str__(self) -> str:
        return str(self.args[0])


class UnknownTask(NotFound, IndexError):
    """A suite has no task of this index; the message gives the valid range."""


class TaskDataError(InvalidFile):
    """A file of an installed suite is missing or not what it should be; the message names it.

    Attributes:
        path: the file.
    """

    def __init__(self, path: Path, problem: str) -> None:
        super().__init__(path, problem)
        self.path = path
        self.problem = problem

    def __str__(self) -> str:
        return f"{self.path}: {self.problem}"


@dataclass(frozen=True)
class TaskSpec:
    """One task of a suite.

    Attributes:
        suite: suite name.
        index: place in the suite, from 0, in upstream's task order 0.
        name: upstream's task name, the stem of its files.
        bddl_path: task file.
        init_states_path: start states (.npz).
    """

    suite: str
    index: int
    name: str
    bddl_path: Path
    init_states_path: Path

    @property
    def instruction(self) -> str:
        """The instruction that a policy receives.

        The sentence in the task's name for LIBERO's own suites and for PRO's ``_object`` and ``_swap`` (upstream's
        ``task.language``, what policies were trained on). PRO's ``_lan`` and ``_task`` rewrite the instruction in the
        task file and keep the name, so there it is the file's: the name would undo the perturbation, and LIBERO-PRO's
        authors evaluate with the environment's instruction (Zxy-MLlab/LIBERO-PRO, threads 14 and 27).

        Raises:
            TaskDataError, BDDLError: the task file is needed and is missing or malformed.
        """
        return self.language_bddl if self.suite.endswith(("_lan", "_task")) else self.language_name

    @property
    def language_name(self) -> str:
        """The sentence in the task's name: upstream's ``task.language`` in every suite."""
        return _SCENE_PREFIX.sub("", self.name).replace("_", " ")

    @property
    def language_bddl(self) -> str:
        """The sentence in the task file, lower case: upstream's ``env.language_instruction`` in every suite.

        Raises:
            TaskDataError, BDDLError: the task file is missing or malformed.
        """
        return self.problem().language

    def problem(self) -> Problem:
        """The parsed task file; parsed once and again only when the file changes.

        Raises:
            TaskDataError: the file is missing.
            BDDLError: it is malformed.
        """
        return _problem(self.bddl_path, _version(self.bddl_path))

    def init_states(self) -> np.ndarray:
        """Start states, float64 [50, 1 + nq + nv], rows of time (seconds), qpos, qvel; read-only, raw (unsettled).

        Fixture poses are not in them. The width is checked against the robot and the objects of the task file.

        Raises:
            TaskDataError: the file is missing, unreadable, or its array has another shape or non-finite values.
            BDDLError: the task file is malformed.
        """
        _version(self.init_states_path)
        states = _read_states(self.init_states_path)
        _check_states(self.init_states_path, states, len(self.problem().objects))
        states = np.ascontiguousarray(states, dtype=np.float64)
        states.setflags(write=False)
        return states


def list_suites() -> tuple[str, ...]:
    """Names of the 21 suites: LIBERO's five, then LIBERO-PRO's sixteen."""
    return BASE_SUITES + PRO_SUITES


def list_tasks(suite: str) -> tuple[TaskSpec, ...]:
    """Tasks of a suite in upstream's task order 0.

    Raises:
        UnknownSuite: no such suite.
        AssetsMissing: the task files are not installed.
        TaskDataError: the installed task map does not list the suite.
    """
    if suite not in list_suites():
        raise UnknownSuite(_did_you_mean(suite, list_suites()))
    root = libero_root()
    path = root / "benchmark" / "libero_suite_task_map.py"
    names = _task_map(path, _version(path)).get(suite)
    if names is None:
        raise TaskDataError(path, f"lists no suite {suite!r}")
    return tuple(_spec(root, suite, index, name) for index, name in enumerate(names))


def task(suite: str, index: SupportsIndex) -> TaskSpec:
    """One task of a suite.

    Raises:
        UnknownSuite: no such suite.
        UnknownTask: no such index; negative ones are not counted from the end.
    """
    tasks = list_tasks(suite)
    place = operator.index(index)
    if not 0 <= place < len(tasks):
        raise UnknownTask(f"{suite} has tasks 0 to {len(tasks) - 1}, not {place}")
    return tasks[place]


def _spec(root: Path, suite: str, index: int, name: str) -> TaskSpec:
    return TaskSpec(
        suite=suite,
        index=index,
        name=name,
        bddl_path=root / "bddl_files" / suite / f"{name}.bddl",
        init_states_path=root / "init_files" / suite / f"{name}.pruned_init.npz",
    )


def _did_you_mean(name: str, valid: Iterable[str]) -> str:
    names = list(valid)
    near = difflib.get_close_matches(str(name).lower(), names, n=1)
    hint = f", did you mean {near[0]!r}?" if near else "."
    return f"no suite {name!r}{hint} Suites: {', '.join(names)}"


def _version(path: Path) -> tuple[int, int]:
    """Modification time and size, which key the caches; `TaskDataError` when there is no such file."""
    try:
        status = path.stat()
    except FileNotFoundError:
        raise TaskDataError(path, "there is no such file in the installed package") from None
    return status.st_mtime_ns, status.st_size


@functools.cache
def _problem(path: Path, version: tuple[int, int]) -> Problem:
    return load_problem(path)


@functools.cache
def _task_map(path: Path, version: tuple[int, int]) -> dict[str, tuple[str, ...]]:
    """The dictionary literal that upstream's module assigns, without running the module."""
    try:
        for node in ast.parse(path.read_bytes(), str(path)).body:
            match node:
                case ast.Assign(targets=[ast.Name(id=name)], value=value) if name == _TASK_MAP_NAME:
                    return {str(suite): tuple(map(str, names)) for suite, names in ast.literal_eval(value).items()}
    except (SyntaxError, ValueError, TypeError, AttributeError) as error:
        raise TaskDataError(path, f"no readable {_TASK_MAP_NAME}: {error}") from None
    raise TaskDataError(path, f"assigns no {_TASK_MAP_NAME}")


def _read_states(path: Path) -> np.ndarray:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return archive["states"]
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise TaskDataError(path, f"not an .npz archive with an array 'states': {error}") from None


def _check_states(path: Path, states: np.ndarray, num_objects: int) -> None:
    if states.dtype.kind != "f":
        raise TaskDataError(path, f"start states are {states.dtype}, not floating point")
    if states.ndim != 2 or len(states) != NUM_EPISODES:
        raise TaskDataError(path, f"start states have shape {states.shape}, not ({NUM_EPISODES}, 1 + nq + nv)")
    least = 1 + _ROBOT_COLUMNS + _OBJECT_COLUMNS * num_objects
    if states.shape[1] < least or (states.shape[1] - least) % 2:
        problem = f"start states have {states.shape[1]} columns; {num_objects} objects need {least}"
        raise TaskDataError(path, f"{problem} plus an even number for the joints of fixtures")
    if not np.isfinite(states).all():
        row = int(np.argwhere(~np.isfinite(states))[0, 0])
        raise TaskDataError(path, f"start state {row} holds a value that is not finite")
