"""What a machine without LIBERO's packages draws: the folder ``images`` inside one that ``vecenv compile`` wrote.

In: suites of the installed packages. Out: ``images/index.json`` (version of MuJoCo; for each scene the files of what is
drawn, by engine, level of detail and colours), a file for each of these, and ``images/pieces``, the textures and meshes
that they share (``vecenv.libero.render.packing``). ``ExportedVisuals`` reads them.

The index is written last. An export that was interrupted is completed by the next one, which keeps what is whole; what
an earlier export wrote for other scenes, engines, levels or colours stays. The name of a file is a hash of what went
into it, and the index has its checksum.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import mujoco
import numpy as np

from vecenv.libero.render import lod
from vecenv.libero.render.colors import visual_scene
from vecenv.libero.render.flatten import Burner
from vecenv.libero.render.options import ENGINES, LODS, RenderConfig, RenderError, check_colors
from vecenv.libero.render.packing import PackingError, Pieces
from vecenv.libero.render.scenery import Scenery, scenery_of
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.cache import content_key, named_scene, scene_names
from vecenv.libero.scene.scene import Scene, compile_scene, scene_source
from vecenv.libero.tasks.export import IMAGES, ExportError, ExportFolder, seal
from vecenv.libero.tasks.seal import break_seal
from vecenv.libero.tasks.suites import list_suites, list_tasks
from vecenv.util import caching

INDEX, PIECES = "index.json", "pieces"
# Layout of the folder and version of what is drawn; raised when either changes.
FORMAT = 1
# Levels of detail that images have by default: those of ``RenderConfig``, and with rays of ``FunctionalConfig``.
USUAL_LODS: Mapping[str, tuple[str, ...]] = {"gl": (RenderConfig().lod,), "raytrace": (RenderConfig().lod, "fast")}

_Track: TypeAlias = Callable[[Sequence[Any], str], Iterable[Any]]


@dataclass(frozen=True, kw_only=True)
class Look:
    """What is drawn of a scene: by which engine, with which level of detail, with which colours."""

    engine: str
    lod: str
    colors: str

    def __post_init__(self) -> None:
        for name, known in (("engine", ENGINES), ("lod", LODS)):
            if getattr(self, name) not in known:
                raise RenderError(f"{name}={getattr(self, name)!r}: expected one of {', '.join(known)}")
        check_colors(self.colors)

    def __str__(self) -> str:
        return f"{self.engine} {self.lod} {self.colors}"


@dataclass(frozen=True, kw_only=True)
class ExportedImages:
    """What an export of images wrote: scenes, looks of a scene, and bytes of their files in all."""

    scenes: int
    looks: int
    size: int


def looks(engines: Sequence[str], lods: Sequence[str] = (), colors: Sequence[str] = ("published",)) -> tuple[Look, ...]:
    """Every combination of these, with ``USUAL_LODS`` where no level is given.

    Raises:
        RenderError: an engine, level or colours that do not exist.
    """
    return tuple(
        dict.fromkeys(
            Look(engine=engine, lod=level, colors=each)
            for engine in engines
            for level in lods or USUAL_LODS.get(engine, LODS)
            for each in colors
        )
    )


# -- writing -----------------------------------------------------------------------------------------------------------


def _untracked(items: Sequence[Any], what: str) -> Sequence[Any]:
    return items


def export_images(
    out: str | Path, chosen: Sequence[Look], suites: Sequence[str] | None = None, *, track: _Track = _untracked
) -> ExportedImages:
    """Write what is drawn of the scenes of some suites into a folder that ``vecenv.libero.tasks.export`` wrote.

    Args:
        out: the folder.
        chosen: the looks of each scene.
        suites: which; all of them by default.
        track: see ``vecenv.libero.tasks.export.export``.

    Raises:
        UnknownSuite, AssetsMissing, BDDLError, SceneError: what is to be exported is not there or not in order.
        OSError: the folder cannot be written.
    """
    break_seal(Path(out))
    names = list_suites() if suites is None else suites
    problems = {_name(problem): problem for suite in names for problem in (t.problem() for t in list_tasks(suite))}
    writer = _Writer(Path(out) / IMAGES)
    wanted = [(name, look) for name in problems for look in chosen]
    entries = _kept_entries(Path(out) / IMAGES)
    files: dict[str, int] = {}
    for name, look in track(wanted, "images"):
        key, listed = writer.write(problems[name], look)
        files |= writer.sizes(key, listed)
        path = writer.folder / f"{key}.json"
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        entries.setdefault(name, {})[str(look)] = {"file": path.name, "sha256": digest}
    index = {"format": FORMAT, "mujoco": mujoco.__version__, "scenes": entries}
    caching.write_file(writer.folder / INDEX, json.dumps(index, indent=1).encode())
    seal(Path(out))
    return ExportedImages(scenes=len(problems), looks=len(chosen), size=sum(files.values()))


class _Writer:
    """Writes looks of scenes that are not there yet."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._pieces = folder, Pieces(folder / PIECES)
        folder.mkdir(parents=True, exist_ok=True)

    def write(self, problem: Problem, look: Look) -> tuple[str, Mapping[str, Any]]:
        """Write a look of a scene; returns the name of its file without the ending, and the list of its pieces."""
        parts = [FORMAT, str(look), content_key(scene_source(problem, visual=True)), _simplified_key(look.lod)]
        key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
        path = self.folder / f"{key}.json"
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError, PackingError):
            listed = json.loads(path.read_bytes())["model"]
            self._pieces.check(listed)
            return key, listed
        model, about = _drawn(problem, look)
        listed = self._pieces.write(model)
        mujoco.mj_clearCache(mujoco.mj_getCache())  # decoded files, hundreds of megabytes
        caching.write_file(path, json.dumps({**about, "model": listed}).encode())
        return key, listed

    def sizes(self, key: str, listed: Mapping[str, Any]) -> dict[str, int]:
        """Bytes of the files of a look, by name."""
        return {key: (self.folder / f"{key}.json").stat().st_size, **self._pieces.sizes(listed)}


def _drawn(problem: Problem, look: Look) -> tuple[mujoco.MjModel, dict[str, Any]]:
    """The model of a look, and everything else about it, ready for JSON."""
    if look.engine == "gl":
        scene = visual_scene(problem, look.colors, look.lod)
        return scene.model, {"names": scene_names(scene)}
    scenery = scenery_of(compile_scene(problem, visual=True), level=look.lod, colors=look.colors)
    return scenery.model, {
        "instances": scenery.instances,
        "instance_of_geom": scenery.instance_of_geom.tolist(),
        "burners": [dataclasses.asdict(burner) for burner in scenery.burners],
    }


def _name(problem: Problem) -> str:
    """What a scene is found by in the index: a hash of its problem class, fixtures and objects."""
    name, *things = problem.scene_key()
    key = [name, *([dataclasses.astuple(thing) for thing in each] for each in things)]
    return hashlib.sha256(json.dumps(key).encode()).hexdigest()[:16]


def _simplified_key(level: str) -> str:
    if level not in lod.STORED:
        return ""
    return hashlib.sha256(Path(lod.__file__).with_name(lod.FILE).read_bytes()).hexdigest()


def _kept_entries(folder: Path) -> dict[str, dict[str, Any]]:
    """Entries of an index that is there, if this version of everything wrote it."""
    with contextlib.suppress(ExportError):
        return {name: dict(entry) for name, entry in _read_index(folder, "").items()}
    return {}


# -- reading -----------------------------------------------------------------------------------------------------------


class ExportedVisuals:
    """Draws what an exported folder holds; see ``vecenv.libero.render.sources.VisualSource``.

    Args:
        scenes: the folder. Its index is read when something is drawn.

    Every method raises ``ExportError`` if the folder does not hold what is requested, or a file is damaged, or another
    version of MuJoCo wrote it; the message has the command that writes it.
    """

    def __init__(self, scenes: str | Path) -> None:
        self._scenes, self._folder = Path(scenes), Path(scenes) / IMAGES
        self._pieces = Pieces(self._folder / PIECES)

    def key(self, problem: Problem) -> object:
        """See `VisualSource`."""
        return str(self._scenes.resolve()), problem.scene_key()

    def scene(self, problem: Problem, *, level: str, colors: str) -> Scene:
        """See `VisualSource`."""
        about, path = self._about(problem, Look(engine="gl", lod=level, colors=colors))
        model = self._model(about)
        try:
            return named_scene(model, about["names"])
        except (KeyError, TypeError, AttributeError) as error:
            raise self._damaged(path) from error

    def scenery(self, problem: Problem, *, level: str, colors: str) -> Scenery:
        """See `VisualSource`; the same object while it is in use."""
        about, path = self._about(problem, Look(engine="raytrace", lod=level, colors=colors))
        found = _sceneries.get(path)
        if found is None:
            model = self._model(about)
            try:
                found = Scenery(
                    model=model,
                    instances=tuple(about["instances"]),
                    instance_of_geom=np.array(about["instance_of_geom"], np.int16),
                    burners=tuple(Burner(**{**each, "knobs": tuple(each["knobs"])}) for each in about["burners"]),
                    colors=colors,
                )
            except (KeyError, TypeError, ValueError) as error:
                raise self._damaged(path) from error
            _sceneries[path] = found
        return found

    def _about(self, problem: Problem, look: Look) -> tuple[dict[str, Any], Path]:
        """What the file of a look says, and its path."""
        entry = self._index.get(_name(problem), {}).get(str(look))
        if entry is None:
            raise ExportError(
                f"{self._scenes}: holds no images of {problem.source} for engine={look.engine!r}, lod={look.lod!r}, "
                f"colors={look.colors!r}; run `{self._command(look)}`, where LIBERO's packages are installed"
            )
        path = self._folder / entry["file"]
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ExportError(f"{path}: cannot be read: {error.strerror}; {self._again}") from error
        if hashlib.sha256(data).hexdigest() != entry["sha256"]:
            raise self._damaged(path)
        return json.loads(data), path

    def _model(self, about: Mapping[str, Any]) -> mujoco.MjModel:
        try:
            return self._pieces.read(about["model"])
        except PackingError as error:
            raise ExportError(f"{error}; {self._again}") from error

    def _command(self, look: Look) -> str:
        """The command that adds a look to the folder."""
        more = f"--images {look.engine} --lod {look.lod}"
        if look.colors != RenderConfig().colors:
            more += f" --colors {look.colors}"
        return ExportFolder(self._scenes).command(more)

    @cached_property
    def _index(self) -> Mapping[str, Mapping[str, Any]]:
        ExportFolder(self._scenes)  # refuses one that is not as it was sealed
        return _read_index(self._folder, self._again)

    @property
    def _again(self) -> str:
        return f"run `vecenv compile --out {self._scenes}` with the same options again"

    def _damaged(self, path: Path) -> ExportError:
        return ExportError(f"{path}: damaged: not the file that {IMAGES}/{INDEX} names; {self._again}")


def _read_index(folder: Path, again: str) -> Mapping[str, Mapping[str, Any]]:
    """Scene -> look -> ``{"file": name, "sha256": checksum}``; empty if there is none."""
    path = folder / INDEX
    try:
        index = json.loads(path.read_bytes())
        made_by, entries = (index["format"], index["mujoco"]), index["scenes"]
        found = {
            name: {look: {"file": str(each["file"]), "sha256": str(each["sha256"])} for look, each in entry.items()}
            for name, entry in entries.items()
        }
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise ExportError(f"{path}: cannot be read: {error.strerror}; {again}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ExportError(f"{path}: damaged: not the index of images; {again}") from error
    if made_by != (FORMAT, mujoco.__version__):
        raise ExportError(
            f"{path}: written with MuJoCo {made_by[1]} in layout {made_by[0]}, but this is MuJoCo {mujoco.__version__} "
            f"and layout {FORMAT}; {again}"
        )
    return found


# Sceneries stay while something uses them.
_sceneries: weakref.WeakValueDictionary[Path, Scenery] = weakref.WeakValueDictionary()
