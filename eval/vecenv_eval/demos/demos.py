"""Demonstration files: HDF5 in the layout of LIBERO's published demonstrations, read and written.

A file has a group ``data`` (attributes ``bddl_file_name``, ``problem_info``, ...) with one group a demonstration:
``actions`` [T, 7], ``states`` [T, 1 + nq + nv] (row t is time, qpos, qvel *before* action t), ``rewards`` and ``dones``
[T], and as attributes the state it begins in (``init_state``) and the MJCF it was recorded in (``model_file``), where
fixture poses are. Files of our own evaluations have the same layout; in place of an MJCF they say which episode it is
and what ``vecenv.make`` was called with, so that a replay begins bit for bit where the recording did.

Files come from anywhere, so nothing in them is trusted: no link is followed out of the file, sizes are checked before
anything is read, nothing is unpickled or evaluated, and MJCF is scanned without expanding entities. What is wrong with
one demonstration is said about it, and the others are still there.
"""

from __future__ import annotations

import inspect
import json
import math
import os
import re
import shutil
import xml.parsers.expat
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

import vecenv
from vecenv import protocols
from vecenv.assets import AssetsMissing
from vecenv.contract import ACTION_DIM
from vecenv.errors import InvalidInput
from vecenv.libero.scene.arenas import ARENAS
from vecenv.libero.tasks.suites import NUM_EPISODES, TaskSpec, list_suites, list_tasks
from vecenv.libero.tasks.suites import task as find_spec

SUFFIXES = (".hdf5", ".h5")
# Far beyond any demonstration; a file that asks for more is damaged or hostile.
MAX_TICKS = 100_000
MAX_SETTLE_STEPS = 1_000
_MAX_COLUMNS = 10_000
_MAX_CHUNK_BYTES = 1 << 28
_MAX_TEXT = 1 << 25

_NAME = re.compile(r"demo_?(\d+)")
# The options of ``vecenv.make`` that decide where an episode begins and how it goes; no path is among them.
_OPTIONS = frozenset(
    {
        *("backend", "geometry", "contacts", "fixtures", "reset_loop", "start", "settle_steps", "max_steps"),
        *("success", "seed"),
    }
)
# Types of those whose default does not say it.
_KINDS = {
    "fixtures": (str, dict),
    "reset_loop": (dict,),
    "start": (str,),
    "settle_steps": (int,),
    "max_steps": (int,),
    "success": (str,),
    "seed": (int,),
}
# What h5py and NumPy raise over a file that is damaged or holds something else.
_DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError, OverflowError, MemoryError)

Pose = tuple[np.ndarray, np.ndarray]


class DemoError(InvalidInput):
    """A demonstration file, or one demonstration in it, cannot be used; the message names both and what is wrong."""


@dataclass(frozen=True, kw_only=True)
class StoredStart:
    """A demonstration that begins in a stored state.

    Attributes:
        state: time (seconds), qpos, qvel, float64 [1 + nq + nv].
        fixtures: name -> (position [3] in metres, quaternion wxyz [4]), world frame; None where the file has no MJCF.
    """

    state: np.ndarray
    fixtures: Mapping[str, Pose] | None


@dataclass(frozen=True, kw_only=True)
class MadeStart:
    """A demonstration that begins where ``vecenv.make`` puts an episode.

    Attributes:
        episode: index of the episode.
        options: keyword arguments of ``vecenv.make``, see ``make_options``.
    """

    episode: int
    options: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Demo:
    """One recorded sequence of actions.

    Attributes:
        path, name: the file, and the demonstration's name in it.
        suite, task: what it is a demonstration of.
        start: where it begins.
        actions: float64 [T, 7], finite.
        success: the verdict on record, None where there is none.
    """

    path: Path
    name: str
    suite: str
    task: int
    start: StoredStart | MadeStart
    actions: np.ndarray
    success: bool | None

    def __len__(self) -> int:
        return len(self.actions)

    def recorded_state(self, ticks: int) -> np.ndarray | None:
        """The state on record after so many ticks: time, qpos, qvel, [1 + nq + nv]; None where there is none.

        Raises:
            DemoError: it is there and cannot be read, or is not finite.
        """
        with _opened(self.path) as file, _about(self.path, self.name):
            group = _member(_member(file, "data", h5py.Group), self.name, h5py.Group)
            if ticks == len(self) and "final_state" in group.attrs:
                return _finite("final_state", _vector(group, "final_state"))
            if "states" not in group or ticks >= len(self):
                return None
            return _finite(f"states row {ticks}", np.asarray(_states(group, len(self))[ticks], float))


@dataclass(frozen=True, kw_only=True)
class Unreadable:
    """A file, or a demonstration in it, that cannot be used.

    Attributes:
        path: the file.
        name: the demonstration, "" when it is the file.
        reason: what is wrong, without either name.
    """

    path: Path
    name: str
    reason: str

    def __str__(self) -> str:
        return ": ".join(filter(None, (str(self.path), self.name, self.reason)))


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One episode of our own, ready to be written.

    Attributes:
        episode: index of the episode.
        success: its verdict.
        fault: why its physics failed, "" when it did not.
        actions: what was executed, [T, 7].
        init_state, final_state: before the first and after the last action, [1 + nq + nv].
        states: before each action, [T, 1 + nq + nv], or None.
        options: keyword arguments of ``vecenv.make``, see ``make_options``; plain JSON types.
    """

    episode: int
    success: bool
    fault: str
    actions: np.ndarray
    init_state: np.ndarray
    final_state: np.ndarray
    states: np.ndarray | None = None
    options: Mapping[str, Any] = field(default_factory=dict)


# -- reading -----------------------------------------------------------------------------------------------------------


def read_demos(path: Path, *, suite: str | None = None, task: int | None = None) -> tuple[list[Demo], list[Unreadable]]:
    """Read every demonstration of a file.

    Args:
        path: the file.
        suite, task: what it demonstrates; by default what the file says, or the task whose name it bears.

    Returns:
        The demonstrations in order of their numbers, and those that cannot be used.

    Raises:
        DemoError: the file as a whole cannot be used.
    """
    with _opened(path) as file, _about(path):
        data = _member(file, "data", h5py.Group)
        spec = _find_task(path, data, suite, task)
        names = sorted((name for name in data if _NAME.fullmatch(name)), key=_number)
        if not names:
            raise DemoError("its group 'data' holds no demonstrations (demo_0, demo_1, ...)")
        demos, bad = [], []
        for name in names:
            try:
                demos.append(_demo(path, data, name, spec))
            except AssetsMissing:
                raise
            except _DAMAGE as error:
                bad.append(Unreadable(path=path, name=name, reason=_reason(error)))
        return demos, bad


def _number(name: str) -> tuple[int, str]:
    return int("".join(filter(str.isdecimal, name))), name


def _demo(path: Path, data: h5py.Group, name: str, spec: TaskSpec) -> Demo:
    group = _member(data, name, h5py.Group)
    actions = _actions(group)
    if "states" in group:
        _states(group, len(actions))
    return Demo(
        path=path,
        name=name,
        suite=spec.suite,
        task=spec.index,
        start=_made_start(group) if "make" in group.attrs else _stored_start(group, spec, len(actions)),
        actions=actions,
        success=_verdict(group, len(actions)),
    )


def _actions(group: h5py.Group) -> np.ndarray:
    dataset = _dataset(group, "actions")
    if dataset.ndim != 2 or dataset.shape[1] != ACTION_DIM or not 1 <= dataset.shape[0] <= MAX_TICKS:
        raise DemoError(
            f"actions: expected [T, {ACTION_DIM}] with T from 1 to {MAX_TICKS:,}, got {_shape(dataset.shape)}"
        )
    actions = np.asarray(dataset[()], float)
    bad = ~np.isfinite(actions).all(axis=1)
    if bad.any():
        raise DemoError(f"actions: row {int(bad.argmax())} is not finite")
    return actions


def _states(group: h5py.Group, ticks: int) -> h5py.Dataset:
    dataset = _dataset(group, "states")
    if dataset.ndim != 2 or dataset.shape[0] != ticks or dataset.shape[1] > _MAX_COLUMNS:
        raise DemoError(f"states: expected one row an action, [{ticks}, 1 + nq + nv], got {_shape(dataset.shape)}")
    return dataset


def _verdict(group: h5py.Group, ticks: int) -> bool | None:
    """Our own ``success``, else the last reward, else the last ``done`` (which is LIBERO's success), else None."""
    if "success" in group.attrs:
        value = group.attrs["success"]
        if not isinstance(value, bool | np.bool_ | np.integer):
            raise DemoError(f"attribute success: expected true or false, got {value!r:.50}")
        return bool(value)
    for name in ("rewards", "dones"):
        if name in group:
            dataset = _dataset(group, name)
            if dataset.shape != (ticks,):
                raise DemoError(f"{name}: expected one number an action, [{ticks}], got {_shape(dataset.shape)}")
            return bool(dataset[ticks - 1] > 0)
    return None


def _stored_start(group: h5py.Group, spec: TaskSpec, ticks: int) -> StoredStart:
    if "init_state" in group.attrs:
        name, state = "init_state", _vector(group, "init_state")
    elif "states" in group:
        name, state = "states row 0", np.asarray(_states(group, ticks)[0], float)
    else:
        raise DemoError("neither the attribute init_state nor states: nothing says where it begins")
    width = spec.init_states().shape[1]
    if len(state) != width:
        raise DemoError(f"{name}: {len(state)} numbers, but a state of {spec.suite} task {spec.index} has {width}")
    text = _text(group, "model_file")
    return StoredStart(state=_finite(name, state), fixtures=None if text is None else fixture_poses(text, spec))


def _made_start(group: h5py.Group) -> MadeStart:
    options = _json(group, "make")
    parameters = inspect.signature(vecenv.make).parameters
    known = parameters.keys() & _OPTIONS
    for option, value in options.items():
        if option not in known:
            raise DemoError(f"attribute make: {option!r:.50} is none of {', '.join(sorted(known))}")
        _check_option(option, value, parameters[option].default)
    episode = group.attrs.get("episode")
    if not isinstance(episode, int | np.integer) or not 0 <= episode < NUM_EPISODES:
        raise DemoError(f"attribute episode: expected 0 to {NUM_EPISODES - 1}, got {episode!r:.50}")
    return MadeStart(episode=int(episode), options=options)


def _check_option(name: str, value: Any, default: Any) -> None:
    """What is wrong with the value itself is found by ``vecenv.make``."""
    kinds = _KINDS.get(name, (type(default),))
    if type(value) not in kinds:
        raise DemoError(f"attribute make: {name}={value!r:.50}: expected {kinds[-1].__name__}")
    if name == "settle_steps" and value > MAX_SETTLE_STEPS:
        raise DemoError(f"attribute make: settle_steps={value}: more than {MAX_SETTLE_STEPS:,}")


def fixture_poses(mjcf: str, spec: TaskSpec) -> dict[str, Pose]:
    """Where the fixtures of a task stand in an MJCF that upstream saved.

    Args:
        mjcf: the text; fixtures are the bodies ``{name}_main`` of its world body.
        spec: the task.

    Returns:
        name -> (position [3] in metres, quaternion wxyz [4]), world frame.

    Raises:
        DemoError: it is not well-formed, declares a document type, or lacks a fixture.
    """
    problem = spec.problem()
    table = ARENAS[problem.name].workspace_category
    wanted = {f"{fixture.name}_main": fixture.name for fixture in problem.fixtures if fixture.category != table}
    found = {wanted[name]: _pose(name, attributes) for name, attributes in _bodies(mjcf, wanted).items()}
    missing = [name for name in wanted.values() if name not in found]
    if missing:
        raise DemoError(f"model_file: no body {missing[0]}_main, the fixture {missing[0]!r} of {spec.name}")
    return found


def _bodies(mjcf: str, wanted: Collection[str]) -> dict[str, Mapping[str, str]]:
    """Attributes of the world's own bodies with these names."""
    found: dict[str, Mapping[str, str]] = {}
    path: list[str] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "body" and path == ["mujoco", "worldbody"] and attributes.get("name") in wanted:
            found[attributes["name"]] = attributes
        path.append(tag)

    def refuse(*_: Any) -> None:
        raise DemoError("model_file: it declares a document type, which no MJCF does")

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, lambda tag: path.pop()
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(mjcf, True)
    except xml.parsers.expat.ExpatError as error:
        raise DemoError(f"model_file: not well-formed XML: {error}") from None
    return found


def _pose(body: str, attributes: Mapping[str, str]) -> Pose:
    turned = {"axisangle", "xyaxes", "zaxis", "euler"} & attributes.keys()
    if turned:
        raise DemoError(f"model_file: body {body} is turned by {min(turned)}; MuJoCo saves quat")
    pos = _numbers(body, "pos", attributes.get("pos", "0 0 0"), 3)
    quat = _numbers(body, "quat", attributes.get("quat", "1 0 0 0"), 4)
    if np.linalg.norm(quat) < 1e-6:
        raise DemoError(f"model_file: body {body}: quat has no length")
    return pos, quat


def _numbers(body: str, name: str, text: str, count: int) -> np.ndarray:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise DemoError(f"model_file: body {body}: {name}={text!r:.50}, expected {count} numbers")
    return values


# -- which task --------------------------------------------------------------------------------------------------------


def _find_task(path: Path, data: h5py.Group, suite: str | None, task: int | None) -> TaskSpec:
    """The task asked for; else the one the file names; else the one whose task file or file name it bears."""
    if suite is None and task is None and "suite" in data.attrs:
        return _named_task(_text(data, "suite"), data.attrs.get("task"))
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


def _named_task(suite: str | None, task: Any) -> TaskSpec:
    if suite not in list_suites():
        raise DemoError(f"attribute suite: {suite!r:.50} is none of {', '.join(list_suites())}")
    specs = list_tasks(suite)
    if not isinstance(task, int | np.integer) or not 0 <= task < len(specs):
        raise DemoError(f"attribute task: expected 0 to {len(specs) - 1}, got {task!r:.50}")
    return specs[int(task)]


def _task_files(path: Path, data: h5py.Group) -> Iterable[Path]:
    """Task files a demonstration file may be about, the surest first."""
    if name := _text(data, "bddl_file_name"):
        yield Path(name)
    if "env_args" in data.attrs:
        name = _json(data, "env_args").get("bddl_file")
        if isinstance(name, str) and name:
            yield Path(name)
    yield Path(path.stem.removesuffix("_demo") + ".bddl")


def _suites(suite: str | None, file: Path) -> list[str]:
    """Suites to look in: the one given, else the one whose folder the task file was in, LIBERO's own, LIBERO-PRO's."""
    if suite is not None:
        return [suite]
    return sorted(list_suites(), key=lambda name: name != file.parent.name)


# -- HDF5, defensively -------------------------------------------------------------------------------------------------


class _opened:
    """A file open for reading; whatever is wrong with it becomes a `DemoError` that names it."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> h5py.File:
        try:
            self._file = h5py.File(self._path, "r")
        except _DAMAGE as error:
            raise DemoError(f"{self._path}: not a readable HDF5 file: {_reason(error)}") from None
        return self._file

    def __exit__(self, *_: object) -> None:
        self._file.close()


class _about:
    """Puts the file's name, and the demonstration's, before what goes wrong inside."""

    def __init__(self, path: Path, name: str = "") -> None:
        self._path, self._name = path, name

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, _DAMAGE) and not isinstance(error, AssetsMissing):
            raise DemoError(str(Unreadable(path=self._path, name=self._name, reason=_reason(error)))) from None


def _reason(error: BaseException) -> str:
    """What went wrong, in one line."""
    text = " ".join(str(error).split()) or "no reason given"
    return text if isinstance(error, DemoError) else f"{type(error).__name__}: {text}"


def _member(group: h5py.Group, name: str, kind: type) -> Any:
    """A group or dataset that lies in the file itself."""
    what = "group" if kind is h5py.Group else "dataset"
    if name not in group:
        raise DemoError(f"it has no {what} {name!r}")
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise DemoError(f"{name!r} is a link to somewhere else")
    member = group[name]
    if not isinstance(member, kind):
        raise DemoError(f"{name!r} is not a {what}")
    return member


def _dataset(group: h5py.Group, name: str) -> h5py.Dataset:
    """A numeric dataset that lies in the file itself and can be read in pieces of a reasonable size."""
    dataset = _member(group, name, h5py.Dataset)
    if dataset.external or dataset.is_virtual:
        raise DemoError(f"{name}: its numbers are in another file")
    if dataset.dtype.kind not in "fiub":
        raise DemoError(f"{name}: expected numbers, got {dataset.dtype}")
    if math.prod(dataset.chunks or ()) * dataset.dtype.itemsize > _MAX_CHUNK_BYTES:
        raise DemoError(f"{name}: its chunks of {_shape(dataset.chunks)} are too large to read")
    return dataset


def _vector(group: h5py.Group, name: str) -> np.ndarray:
    value = np.asarray(group.attrs[name])
    if value.dtype.kind not in "fiu" or value.ndim != 1 or len(value) > _MAX_COLUMNS:
        raise DemoError(f"attribute {name}: expected numbers [1 + nq + nv], got {value.dtype} {_shape(value.shape)}")
    return value.astype(float)


def _finite(name: str, values: np.ndarray) -> np.ndarray:
    if not np.isfinite(values).all():
        raise DemoError(f"{name}: holds a value that is not finite")
    return values


def _text(group: h5py.Group, name: str) -> str | None:
    value = group.attrs.get(name)
    if isinstance(value, bytes):
        value = value.decode()
    if value is not None and not isinstance(value, str):
        raise DemoError(f"attribute {name}: expected text, got {type(value).__name__}")
    if value is not None and len(value) > _MAX_TEXT:
        raise DemoError(f"attribute {name}: {len(value):,} characters, more than {_MAX_TEXT:,}")
    return value


def _json(group: h5py.Group, name: str) -> dict[str, Any]:
    try:
        value = json.loads(_text(group, name) or "")
    except (json.JSONDecodeError, RecursionError) as error:
        raise DemoError(f"attribute {name}: not JSON: {error}") from None
    if not isinstance(value, dict):
        raise DemoError(f"attribute {name}: expected a JSON object, got {type(value).__name__}")
    return value


def _shape(shape: Sequence[int] | None) -> str:
    return f"[{', '.join(map(str, shape or ()))}]"


# -- writing -----------------------------------------------------------------------------------------------------------


def make_options(make: Callable[..., Any], **arguments: Any) -> dict[str, Any]:
    """What ``make(**arguments)`` says about how episodes begin and go, with what defaults and the protocol leave it."""
    signature = inspect.signature(make)
    bound = signature.bind_partial(**arguments)
    bound.apply_defaults()
    given = {name: value for name, value in bound.arguments.items() if value is not None}
    chosen = protocols.protocol(given.get("protocol", protocols.DEFAULT))
    options = {**chosen.options(given.get("suite", "")), **given}
    options["reset_loop"] = asdict(protocols.reset_loop(options["reset_loop"]))
    if options["fixtures"] != "upstream":
        del options["reset_loop"]
    return {name: value for name, value in options.items() if name in _OPTIONS & signature.parameters.keys()}


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
    group.attrs.update(
        num_samples=ticks,
        init_state=recording.init_state,
        final_state=recording.final_state,
        success=recording.success,
        fault=recording.fault,
        episode=recording.episode,
        make=json.dumps(recording.options),
    )
