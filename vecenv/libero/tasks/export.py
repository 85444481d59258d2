"""Suites as one folder that needs no assets: what ``vecenv compile`` writes and ``make(..., scenes=DIR)`` reads.

In: suites of the installed packages. Out: a folder with ``index.json`` (MuJoCo version, tasks of each suite with
instruction, BDDL text and scene), ``scenes/`` (each compiled scene in the two files of ``vecenv.libero.scene.cache``)
and ``starts/{suite}.npz`` (init states, stored and settled). A scene has the contact sensors of all its exported tasks.
A compiled model belongs to one version of MuJoCo, and so does the folder. ``budgets.json`` is there where the contact
memory of MJX was measured as well (``vecenv.libero.contact_memory``). ``seal.json`` is written last and names every
file with its checksum (``vecenv.libero.tasks.seal``); a folder that is not as it was sealed is refused.
"""

from __future__ import annotations

import functools
import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import mujoco
import numpy as np

from vecenv.errors import InvalidFile
from vecenv.libero.scene import goals
from vecenv.libero.scene.bddl import Problem, SceneKey, parse_problem
from vecenv.libero.scene.cache import SceneFileError, compiled_source, content_key, read_scene, write_scene
from vecenv.libero.scene.contacts import Contacts, checked
from vecenv.libero.scene.lean.geometry import PROFILES, demands
from vecenv.libero.scene.scene import Scene, scene_source
from vecenv.libero.tasks import settled
from vecenv.libero.tasks.seal import SEAL, SealError, break_seal, open_seal, write_seal
from vecenv.libero.tasks.settled import SettledStarts
from vecenv.libero.tasks.suites import NUM_EPISODES, TaskSpec, list_suites, list_tasks
from vecenv.util import caching

INDEX, SCENES, STARTS = "index.json", "scenes", "starts"
# What is drawn, if the export has it; ``vecenv.libero.render.exported`` writes and reads it.
IMAGES = "images"
BUDGETS = "budgets.json"
# Layout of the folder; raised when it changes.
FORMAT = 4

_Result = TypeVar("_Result")
Track: TypeAlias = Callable[[Sequence[Any], str], Iterable[Any]]


class ExportError(InvalidFile):
    """An exported folder cannot be written or used; the message names the file and says what to do."""


@dataclass(frozen=True, kw_only=True)
class Exported:
    """What an export wrote: the folder, how many suites, tasks and scenes, and their size in bytes."""

    folder: Path
    suites: int
    tasks: int
    scenes: int
    size: int


# -- writing -----------------------------------------------------------------------------------------------------------


def untracked(items: Sequence[Any], what: str) -> Sequence[Any]:
    """A ``Track`` that shows nothing."""
    del what
    return items


def export(
    out: str | Path,
    suites: Sequence[str] | None = None,
    *,
    geometries: Sequence[str] = ("exact",),
    contacts: Contacts = "published",
    track: Track = untracked,
) -> Exported:
    """Write suites into a folder; one that an earlier export wrote is brought up to date.

    Args:
        out: the folder, created if need be.
        suites: which; all of them by default.
        geometries: profiles of the collision geoms, see ``vecenv.libero.scene.lean.geometry``. ``"lean"`` brings
            ``"exact"`` with it: parts of lean scenes are measured on the exact ones.
        contacts: those of the exported scenes, see ``vecenv.libero.scene.contacts``.
        track: called with a list of what is to be done and a word for it, returns it to iterate over: where a progress
            bar goes.

    Raises:
        ExportError: ``out`` is a file, or a folder that holds something else.
        ContactsError: other contacts.
        UnknownSuite, AssetsMissing, TaskDataError, BDDLError, SceneError, SettledStartsError: what is to be exported is
            not there or not in order.
        OSError: the folder cannot be written.
    """
    checked(contacts)
    folder = _writable(Path(out))
    break_seal(folder)
    tasks = {suite: list_tasks(suite) for suite in dict.fromkeys(list_suites() if suites is None else suites)}
    sharing: dict[SceneKey, list[Problem]] = {}
    in_suite: dict[tuple[str, SceneKey], list[Problem]] = {}
    for problem, suite in ((spec.problem(), spec.suite) for specs in tasks.values() for spec in specs):
        sharing.setdefault(problem.scene_key(), []).append(problem)
        in_suite.setdefault((suite, problem.scene_key()), []).append(problem)
    profiles = dict.fromkeys(["exact", *geometries] if "lean" in geometries else geometries)
    wanted = [(suite, key, profile) for suite, key in in_suite for profile in profiles]
    ids = {
        (suite, key, profile): _write_scene(
            folder, sharing[key], in_suite[suite, key] if profile == "lean" else None, contacts
        )
        for suite, key, profile in track(wanted, "scenes")
    }
    entries = {suite: _write_suite(folder, tasks[suite], ids) for suite in track(list(tasks), "starts")}
    index = {"format": FORMAT, "mujoco": mujoco.__version__, "contacts": contacts, "suites": entries}
    caching.write_file(folder / INDEX, json.dumps(index, indent=1).encode())
    written = _files(folder, tasks, ids.values())
    for path in (*(folder / SCENES).glob("*"), *(folder / STARTS).glob("*.npz")):  # an earlier export's
        if path not in written and path.suffix in (".mjb", ".json", ".npz"):
            path.unlink()
    seal(folder)
    return Exported(
        folder=folder,
        suites=len(tasks),
        tasks=sum(map(len, tasks.values())),
        scenes=len(set(ids.values())),
        size=sum(path.stat().st_size for path in written),
    )


def seal(folder: Path) -> None:
    """Seal a folder that is written.

    Raises:
        ExportError: it holds a file that no export writes.
        OSError: a file cannot be read, or the seal not be written.
    """
    try:
        write_seal(folder)
    except SealError as error:
        raise ExportError(str(error)) from error


def _writable(folder: Path) -> Path:
    if folder.exists() and not folder.is_dir():
        raise ExportError(f"{folder}: not a folder; name a new one, or one that an export wrote")
    if folder.is_dir() and not (folder / INDEX).is_file():
        ours = (SCENES, STARTS, IMAGES, BUDGETS, SEAL)  # left by an export that was interrupted
        others = [path.name for path in folder.iterdir() if path.name not in ours and not path.name.startswith(".")]
        if others:
            raise ExportError(f"{folder}: not an export, it holds {min(others)}; name a new folder")
    (folder / STARTS).mkdir(parents=True, exist_ok=True)
    return folder


def _files(folder: Path, suites: Iterable[str], ids: Iterable[str]) -> list[Path]:
    scenes = [folder / SCENES / f"{key}{suffix}" for key in set(ids) for suffix in (".mjb", ".json")]
    return [folder / INDEX, *scenes, *(folder / STARTS / f"{suite}.npz" for suite in suites)]


def _write_scene(
    folder: Path, problems: Sequence[Problem], lean_for: Sequence[Problem] | None, contacts: Contacts
) -> str:
    """Write the scene these problems share, with lean geoms for some of them or upstream's; returns its id."""
    source = scene_source(problems[0], contact_pairs=goals.contact_pairs(problems), contacts=contacts)
    asked = None if lean_for is None else demands(lean_for)
    key = content_key(source, asked)
    try:
        read_scene(folder / SCENES, key)
    except SceneFileError:
        write_scene(folder / SCENES, key, compiled_source(source, asked))
    return key


def _write_suite(
    folder: Path, specs: Sequence[TaskSpec], ids: Mapping[tuple[str, SceneKey, str], str]
) -> dict[str, Any]:
    """Write the starts of a suite; returns its entry in the index."""
    arrays: dict[str, np.ndarray] = {}
    for spec in specs:
        starts = settled.load(spec)
        arrays[f"raw_{spec.index}"] = spec.init_states()
        arrays[f"qpos_{spec.index}"], arrays[f"qvel_{spec.index}"] = starts.qpos, starts.qvel
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    data = buffer.getvalue()
    caching.write_file(folder / STARTS / f"{specs[0].suite}.npz", data)
    entries = [
        {
            "name": spec.name,
            "instruction": spec.instruction,
            "scenes": {
                profile: ids[spec.suite, spec.problem().scene_key(), profile]
                for profile in PROFILES
                if (spec.suite, spec.problem().scene_key(), profile) in ids
            },
            "bddl": spec.bddl_path.read_text(encoding="utf-8-sig"),
        }
        for spec in specs
    ]
    return {"starts": hashlib.sha256(data).hexdigest(), "tasks": entries}


def write_budgets(folder: Path, budgets: Mapping[str, Mapping[str, int | None]]) -> None:
    """Write the contact memory of scenes, by ``vecenv.libero.physics.budgets.key_of``, into an exported folder."""
    break_seal(folder)
    caching.write_file(folder / BUDGETS, json.dumps(dict(sorted(budgets.items())), indent=1).encode())
    seal(folder)


# -- reading -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ExportedTask:
    """A task read from an exported folder; see ``vecenv.libero.tasks.sources.Task``.

    Attributes:
        suite, index, name, instruction: as in ``TaskSpec``.
        bddl: text of the task file.
        scene_ids: which of the folder's scenes it plays in, by geometry profile.
        folder: the folder.
    """

    suite: str
    index: int
    name: str
    instruction: str
    bddl: str = field(repr=False)
    scene_ids: Mapping[str, str]
    folder: ExportFolder = field(repr=False)

    def problem(self) -> Problem:
        """The parsed task file.

        Raises:
            BDDLError: the index was edited.
        """
        return _parsed(self.bddl, f"{self.folder.path / INDEX}, {self.suite} task {self.index}")

    def init_states(self) -> np.ndarray:
        """The stored init states [50, 1 + nq + nv]; raises `ExportError`."""
        return self.folder.array(self.suite, f"raw_{self.index}")

    def settled(self) -> SettledStarts:
        """The init states at rest; raises `ExportError`."""
        return SettledStarts(*(self.folder.array(self.suite, f"{name}_{self.index}") for name in ("qpos", "qvel")))

    def scene(
        self,
        contact_pairs: tuple[tuple[str, str], ...],
        lean_for: tuple[Problem, ...] | None = None,
        contacts: Contacts = "published",
    ) -> Scene:
        """The compiled scene; it has the contact sensors of every exported task.

        Raises:
            ExportError: the scene is damaged, or was not exported with this geometry or these contacts.
        """
        profile = "exact" if lean_for is None else "lean"
        if profile not in self.scene_ids:
            every = " ".join(f"--geometry {name}" for name in (*self.scene_ids, profile))
            raise ExportError(
                f"{self.folder.path}: holds no {profile} scenes of {self.suite}; "
                f"run `vecenv compile --out {self.folder.path} {every}` again"
            )
        if contacts != self.folder.contacts:
            raise ExportError(
                f"{self.folder.path}: exported with contacts={self.folder.contacts!r}, requested {contacts!r}; use "
                f"that, or `vecenv compile --out DIR --contacts {contacts}` for a new folder"
            )
        return self.folder.scene(self.scene_ids[profile])


_parsed = functools.lru_cache(maxsize=512)(parse_problem)


class ExportFolder:
    """An exported folder, opened: seal and index are read and checked at once, scenes and starts on access.

    Args:
        path: the folder.

    Raises:
        ExportError: there is no such folder, it is no export or a damaged one, or another MuJoCo compiled it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._again = f"run `vecenv compile --out {self.path}` again"
        self._index = self._read_index()
        self._seal = self._sealed(lambda: open_seal(self.path))
        self._scenes: dict[str, Scene] = {}
        self._starts: dict[str, dict[str, np.ndarray]] = {}

    @property
    def suites(self) -> tuple[str, ...]:
        """The suites it holds."""
        return tuple(self._index)

    def command(self, more: str) -> str:
        """The command that writes what the folder holds, with more options."""
        held = {profile: None for _, tasks in self._index.values() for task in tasks for profile in task.scene_ids}
        options = [f"--suite {suite}" for suite in self.suites] if set(self.suites) != set(list_suites()) else []
        options += [f"--geometry {profile}" for profile in held if tuple(held) != ("exact",)]
        if self.contacts != "published":
            options.append(f"--contacts {self.contacts}")
        return " ".join(["vecenv compile --out", str(self.path), *options, more])

    def tasks(self, suite: str) -> tuple[ExportedTask, ...]:
        """The tasks of a suite in upstream's order.

        Raises:
            ExportError: the folder does not hold the suite.
        """
        if suite not in self._index:
            raise ExportError(
                f"{self.path}: holds no suite {suite!r}; it holds {', '.join(self.suites) or 'none'}. "
                f"To add it, name it among the --suite of `vecenv compile`"
            )
        return self._index[suite][1]

    def scene(self, key: str) -> Scene:
        """A scene, the same object for the same id; raises `ExportError`."""
        if key not in self._scenes:
            for suffix in (".mjb", ".json"):
                self.check(f"{SCENES}/{key}{suffix}")
            try:
                self._scenes[key] = read_scene(self.path / SCENES, key)
            except SceneFileError as error:
                raise ExportError(f"{error}; {self._again}") from error
        return self._scenes[key]

    def starts(self, suite: str) -> dict[str, np.ndarray]:
        """The read-only arrays ``raw_{task}``, ``qpos_{task}`` and ``qvel_{task}`` of a suite; raises `ExportError`."""
        if suite not in self._starts:
            path = self.path / STARTS / f"{suite}.npz"
            self.check(f"{STARTS}/{suite}.npz")
            data = self._read(path)
            if hashlib.sha256(data).hexdigest() != self._index[suite][0]:
                raise ExportError(f"{path}: damaged: not the file that {INDEX} names; {self._again}")
            try:
                with np.load(io.BytesIO(data), allow_pickle=False) as file:
                    self._starts[suite] = {name: _frozen(file[name]) for name in file.files}
            except (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
                raise ExportError(f"{path}: damaged: not the starts of an export; {self._again}") from error
        return self._starts[suite]

    def array(self, suite: str, name: str) -> np.ndarray:
        """One of the arrays of ``starts``, finite floats of 50 rows; raises `ExportError`."""
        found, path = self.starts(suite).get(name), self.path / STARTS / f"{suite}.npz"
        if found is None or found.ndim != 2 or len(found) != NUM_EPISODES or found.dtype.kind != "f":
            raise ExportError(f"{path}: damaged: {name} is missing, or not the states of {NUM_EPISODES} episodes")
        bad = ~np.isfinite(found).all(axis=1)
        if bad.any():
            raise ExportError(f"{path}: damaged: {name} of episode {int(bad.argmax())} is not finite; {self._again}")
        return found

    def check(self, name: str) -> None:
        """Check the contents of a file, given its path in the folder; raises `ExportError`."""
        self._sealed(lambda: self._seal.check(name))

    def _sealed(self, call: Callable[[], _Result]) -> _Result:
        try:
            return call()
        except SealError as error:
            raise ExportError(f"{error}; {self._again}") from error

    def budgets(self) -> Mapping[str, Mapping[str, int | None]]:
        """The numbers of each ``Budget`` by ``vecenv.libero.physics.budgets.key_of``; empty where none was exported.

        Raises:
            ExportError: the file is damaged.
        """
        path = self.path / BUDGETS
        if not path.exists():
            return {}
        try:
            return {str(key): dict(numbers) for key, numbers in json.loads(self._read(path)).items()}
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise self.budgets_damaged() from error

    def budgets_damaged(self) -> ExportError:
        """What to raise when the numbers of ``budgets`` make no sense."""
        return ExportError(f"{self.path / BUDGETS}: damaged: not the budgets of an export; delete it")

    def _read(self, path: Path) -> bytes:
        try:
            return path.read_bytes()
        except OSError as error:
            raise ExportError(f"{path}: cannot be read: {error.strerror}; {self._again}") from error

    def _read_index(self) -> dict[str, tuple[str, tuple[ExportedTask, ...]]]:
        """Suite -> checksum of its starts, its tasks."""
        if not self.path.is_dir():
            raise ExportError(f"{self.path}: no such folder; `vecenv compile --out {self.path}` makes it")
        path = self.path / INDEX
        data = self._read(path)
        try:
            index = json.loads(data)
            self._check_versions(index["format"], index["mujoco"])
            self.contacts = checked(index["contacts"])
            return {
                suite: (str(entry["starts"]), self._tasks(suite, entry)) for suite, entry in index["suites"].items()
            }
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ExportError(f"{path}: damaged: not the index of an export; {self._again}") from error

    def _check_versions(self, layout: object, version: object) -> None:
        if version != mujoco.__version__:
            raise ExportError(
                f"{self.path}: exported with MuJoCo {version}, running {mujoco.__version__}: "
                f"compiled models belong to one version; {self._again}"
            )
        if layout != FORMAT:
            raise ExportError(f"{self.path}: in layout {layout}, this vecenv reads layout {FORMAT}; {self._again}")

    def _tasks(self, suite: str, entry: Mapping[str, Any]) -> tuple[ExportedTask, ...]:
        return tuple(
            ExportedTask(
                suite=suite,
                index=i,
                name=str(task["name"]),
                instruction=str(task["instruction"]),
                bddl=str(task["bddl"]),
                scene_ids={profile: str(key) for profile, key in task["scenes"].items()},
                folder=self,
            )
            for i, task in enumerate(entry["tasks"])
        )


def _frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


def exported_tasks(folder: str | Path, suite: str) -> tuple[ExportedTask, ...]:
    """The tasks of a suite from an exported folder; errors of `ExportFolder`."""
    return ExportFolder(folder).tasks(suite)
