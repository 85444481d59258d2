"""Demonstrations read from HDF5 files, published ones and our own.

Files come from anywhere, so nothing in them is trusted (see ``hdf5`` and ``mjcf``), and they are read in a process of
their own (``reader``). What is wrong with one demonstration is reported about that one, and the others can still be
used. Functions that end in ``_here`` read in this process.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

import vecenv
from vecenv.assets import AssetsMissing
from vecenv.contract import ACTION_DIM
from vecenv.libero.tasks.suites import NUM_EPISODES, TaskSpec, list_suites, list_tasks
from vecenv.libero.tasks.suites import task as find_spec
from vecenv.simpler.published import lists
from vecenv_eval.demos.hdf5 import (
    DAMAGE,
    DemoError,
    Errors,
    Opened,
    Unreadable,
    attribute,
    error_reason,
    json_attribute,
    member,
    numeric_dataset,
    require_finite,
    shape_text,
    states_dataset,
    text_attribute,
    vector_attribute,
)
from vecenv_eval.demos.mjcf import fixture_poses
from vecenv_eval.demos.options import check_options
from vecenv_eval.demos.reader import READER
from vecenv_eval.demos.schema import Demo, MadeStart, StoredStart

if TYPE_CHECKING:
    from vecenv.registry import TaskInfo

# Far beyond any demonstration; a file that asks for more is damaged or hostile.
MAX_TICKS = 100_000
# Of one file; LIBERO's published ones have 50 demonstrations of some hundred actions each.
MOST_DEMOS, MOST_TICKS_OF_A_FILE = 20_000, 2_000_000
_NAME = re.compile(r"demo_?([0-9]{1,18})")


def read_demos(path: Path, *, suite: str | None = None, task: int | None = None) -> tuple[list[Demo], list[Unreadable]]:
    """Read every demonstration of a file.

    Args:
        path: the file.
        suite, task: what it demonstrates; by default what the file states, or the task of the same name.

    Returns:
        The demonstrations in order of their numbers, and those that cannot be used.

    Raises:
        DemoError: the file as a whole cannot be used.
        AssetsMissing: files of a simulator are needed to read it.
    """
    answer = READER.ask(path, "read", suite=suite, task=task)
    demos = [_of_answer(path, values, answer.arrays) for values in answer.content["demos"]]
    return demos, [Unreadable(path=path, name=name, reason=reason) for name, reason in answer.content["bad"]]


def _of_answer(path: Path, values: Mapping[str, Any], arrays: Sequence[np.ndarray]) -> Demo:
    """A demonstration as the reading process sent it."""
    begins, second_half = values["start"], values["second_half"]
    if "episode" in begins:
        start = MadeStart(episode=begins["episode"], options=begins["options"])
    else:
        poses = begins["fixtures"]
        fixtures = None if poses is None else {name: (arrays[a], arrays[b]) for name, (a, b) in poses.items()}
        start = StoredStart(state=arrays[begins["state"]], fixtures=fixtures)
    return Demo(
        path=path,
        name=values["name"],
        suite=values["suite"],
        task=values["task"],
        start=start,
        actions=arrays[values["actions"]],
        success=values["success"],
        second_half=None if second_half is None else arrays[second_half],
        stand_ins=None if values["stand_ins"] is None else tuple(values["stand_ins"]),
    )


def read_here(path: Path, *, suite: str | None = None, task: int | None = None) -> tuple[list[Demo], list[Unreadable]]:
    """As `read_demos`, in this process."""
    with Opened(path) as file, Errors(path):
        data = member(file, "data", h5py.Group)
        found, spec = _find_task(path, data, suite, task)
        names = demo_names(data)
        demos, bad, ticks = [], [], 0
        for name in names:
            try:
                if ticks >= MOST_TICKS_OF_A_FILE:
                    raise DemoError(f"the file has more than {MOST_TICKS_OF_A_FILE:,} actions before it")
                demos.append(_demo(path, data, name, found, spec))
                ticks += len(demos[-1])
            except AssetsMissing:
                raise
            except DAMAGE as error:
                bad.append(Unreadable(path=path, name=name, reason=error_reason(error)))
        return demos, bad


def demo_names(data: h5py.Group) -> list[str]:
    """The demonstrations of a file in order of their numbers.

    Raises:
        DemoError: there are none, or too many.
    """
    if len(data) > MOST_DEMOS:
        raise DemoError(f"its group 'data' has {len(data):,} members, more than {MOST_DEMOS:,}")
    names = sorted((name for name in map(str, data) if _NAME.fullmatch(name)), key=_number)
    if not names:
        raise DemoError("its group 'data' holds no demonstrations (demo_0, demo_1, ...)")
    return names


def state_here(path: Path, name: str, ticks: int, length: int) -> np.ndarray | None:
    """As ``Demo.recorded_state``, in this process.

    Args:
        path, name: the file, and the demonstration in it.
        ticks: after how many.
        length: how many actions the demonstration has.
    """
    with Opened(path) as file, Errors(path, name):
        group = member(member(file, "data", h5py.Group), name, h5py.Group)
        if ticks == length and "final_state" in group.attrs:
            return require_finite("final_state", vector_attribute(group, "final_state"))
        if "states" not in group or ticks >= length:
            return None
        return require_finite(f"states row {ticks}", np.asarray(states_dataset(group, length)[ticks], float))


def check_here(path: Path) -> None:
    """Read every dataset and attribute of a file of our own, in this process.

    Raises:
        DemoError: it is damaged, or something else.
    """
    with Opened(path) as file, Errors(path):
        data = member(file, "data", h5py.Group)
        for name in demo_names(data):
            group = member(data, name, h5py.Group)
            for inner in group:
                numeric_dataset(group, str(inner))[()]
            for each in group.attrs:
                attribute(group, each)


def _number(name: str) -> tuple[int, str]:
    return int(name.removeprefix("demo").removeprefix("_")), name


def _demo(path: Path, data: h5py.Group, name: str, suite: str, spec: TaskInfo) -> Demo:
    group = member(data, name, h5py.Group)
    actions = _actions(group)
    if "states" in group:
        states_dataset(group, len(actions))
    return Demo(
        path=path,
        name=name,
        suite=suite,
        task=spec.index,
        start=_start(group, suite, spec, len(actions)),
        actions=actions,
        success=_verdict(group, len(actions)),
        second_half=_second_half(group, len(actions)),
        stand_ins=_stand_ins(group),
    )


def _actions(group: h5py.Group) -> np.ndarray:
    dataset = numeric_dataset(group, "actions")
    if dataset.ndim != 2 or dataset.shape[1] != ACTION_DIM or not 1 <= dataset.shape[0] <= MAX_TICKS:
        raise DemoError(
            f"actions: expected [T, {ACTION_DIM}] with T from 1 to {MAX_TICKS:,}, got {shape_text(dataset.shape)}"
        )
    actions = np.asarray(dataset[()], float)
    bad = ~np.isfinite(actions).all(axis=1)
    if bad.any():
        raise DemoError(f"actions: row {int(bad.argmax())} is not finite")
    return actions


def _verdict(group: h5py.Group, ticks: int) -> bool | None:
    """Our own ``success``, else the last reward, else the last ``done`` (which is LIBERO's success), else None."""
    if "success" in group.attrs:
        value = attribute(group, "success")
        if not isinstance(value, bool | np.bool_ | np.integer):
            raise DemoError(f"attribute success: expected true or false, got {value!r:.50}")
        return bool(value)
    for name in ("rewards", "dones"):
        if name in group:
            dataset = numeric_dataset(group, name)
            if dataset.shape != (ticks,):
                raise DemoError(f"{name}: expected one number an action, [{ticks}], got {shape_text(dataset.shape)}")
            return bool(dataset[ticks - 1] > 0)
    return None


def _second_half(group: h5py.Group, ticks: int) -> np.ndarray | None:
    """Our own ``second_half``: which actions belong to the second half of a task that has two."""
    if "second_half" not in group:
        return None
    dataset = numeric_dataset(group, "second_half")
    if dataset.shape != (ticks,):
        raise DemoError(f"second_half: expected one number an action, [{ticks}], got {shape_text(dataset.shape)}")
    return np.asarray(dataset[()]) > 0


def _stand_ins(group: h5py.Group) -> tuple[str, ...] | None:
    """Our own ``stand_ins``; None where there is none."""
    text = text_attribute(group, "stand_ins")
    try:
        value = None if text is None else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DemoError(f"attribute stand_ins: not JSON: {error}") from None
    if value is not None and not (isinstance(value, list) and all(isinstance(each, str) for each in value)):
        raise DemoError("attribute stand_ins: expected a JSON list of texts")
    return None if value is None else tuple(value)


def _start(group: h5py.Group, suite: str, spec: TaskInfo, ticks: int) -> MadeStart | StoredStart:
    if "make" in group.attrs:
        return _made_start(group, suite, spec)
    if not isinstance(spec, TaskSpec):
        raise DemoError(f"it has no attribute make, which says where an episode of {suite} begins")
    return _stored_start(group, spec, ticks)


def _stored_start(group: h5py.Group, spec: TaskSpec, ticks: int) -> StoredStart:
    if "init_state" in group.attrs:
        name, state = "init_state", vector_attribute(group, "init_state")
    elif "states" in group:
        name, state = "states row 0", np.asarray(states_dataset(group, ticks)[0], float)
    else:
        raise DemoError("neither the attribute init_state nor states: nothing says where it begins")
    width = spec.init_states().shape[1]
    if len(state) != width:
        raise DemoError(f"{name}: {len(state)} numbers, but a state of {spec.suite} task {spec.index} has {width}")
    text = text_attribute(group, "model_file")
    return StoredStart(state=require_finite(name, state), fixtures=None if text is None else fixture_poses(text, spec))


def _made_start(group: h5py.Group, suite: str, spec: TaskInfo) -> MadeStart:
    options = json_attribute(group, "make")
    check_options(options, suite)
    count = NUM_EPISODES if isinstance(spec, TaskSpec) else _num_episodes(options, spec)
    episode = attribute(group, "episode")
    if not isinstance(episode, int | np.integer) or not 0 <= episode < count:
        raise DemoError(f"attribute episode: expected 0 to {count - 1}, got {episode!r:.50}")
    return MadeStart(episode=int(episode), options=options)


def _num_episodes(options: Mapping[str, Any], spec: TaskInfo) -> int:
    """How many episodes SIMPLER has of a task under the protocol of a recording."""
    protocol = options.get("protocol", lists.SEED)
    try:
        count = lists.num_episodes(protocol, spec.name)
    except lists.PublishedError as error:
        raise DemoError(f"attribute make: {error}") from None
    if not count:
        raise DemoError(f"attribute make: protocol {protocol!r} has no episodes of {spec.name}")
    return count


def _find_task(path: Path, data: h5py.Group, suite: str | None, task: int | None) -> tuple[str, TaskInfo]:
    """The task asked for; else the one the file names; else the one named as its task file or the file is."""
    if "suite" in data.attrs and ((suite is None and task is None) or vecenv.family(suite or "") != "libero"):
        return _named_task(text_attribute(data, "suite"), attribute(data, "task"), suite, task)
    spec = _find_spec(path, data, suite, task)
    return spec.suite, spec


def _find_spec(path: Path, data: h5py.Group, suite: str | None, task: int | None) -> TaskSpec:
    """LIBERO's task asked for, or named as the file's task file or the file is."""
    if suite is not None and suite not in list_suites():
        raise DemoError(f"it does not say which task of which suite it demonstrates, as recordings of {suite} do")
    if suite is not None and task is not None:
        return find_spec(suite, task)
    files = list(_task_files(path, data))
    for file in files:
        for candidate in _suites(suite, file):
            for spec in list_tasks(candidate):
                if spec.name == file.stem:
                    return spec
    names = ", ".join(repr(file.name) for file in files)
    where = f"suite {suite}" if suite else "any suite"
    raise DemoError(
        f"no task of {where} has the name of its task file ({names:.200}): say which with --suite and --task"
    )


def _named_task(
    suite: str | None, task: object, wanted_suite: str | None, wanted_task: int | None
) -> tuple[str, TaskInfo]:
    """The task that a file names, which is the one asked for, if one is."""
    if suite is None or suite not in vecenv.list_suites():
        raise DemoError(f"attribute suite: {suite!r:.50} is none of {', '.join(vecenv.list_suites())}")
    specs = vecenv.list_tasks(suite)
    if not isinstance(task, int | np.integer) or not 0 <= task < len(specs):
        raise DemoError(f"attribute task: expected 0 to {len(specs) - 1}, got {task!r:.50}")
    if wanted_suite not in (None, suite) or wanted_task not in (None, int(task)):
        asked = f"{wanted_suite or suite}{'' if wanted_task is None else f' task {wanted_task}'}"
        raise DemoError(f"it demonstrates {suite} task {task}, not {asked}")
    return suite, specs[int(task)]


def _task_files(path: Path, data: h5py.Group) -> Iterable[Path]:
    """Task files a demonstration file may be about, the surest first."""
    if name := text_attribute(data, "bddl_file_name"):
        yield Path(name)
    if "env_args" in data.attrs:
        name = json_attribute(data, "env_args").get("bddl_file")
        if isinstance(name, str) and name:
            yield Path(name)
    yield Path(path.stem.removesuffix("_demo") + ".bddl")


def _suites(suite: str | None, file: Path) -> list[str]:
    """Suites to look in: the one given, else the one whose folder the task file was in, LIBERO's own, LIBERO-PRO's."""
    if suite is not None:
        return [suite]
    return sorted(list_suites(), key=lambda name: name != file.parent.name)
