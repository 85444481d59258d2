"""Compiled scenes on disk: two files a scene, found by what went into it.

In: a problem. Out: its scene, read from ``{key}.mjb`` (the model in MuJoCo's binary format) and ``{key}.json`` (names
of its objects, fixtures and regions), or compiled and written there. The key is a hash of the MJCF text, the contents
of the files it refers to, the names, the MuJoCo version and the layout of the two files, so nothing in the cache is
ever out of date. Files appear whole (written elsewhere, then renamed), any number of processes may share a
folder, what is damaged is compiled again, and a folder that cannot be written is no error. Exported folders
(``vecenv.libero.tasks.export``) hold their scenes in the same two files.

``vecenv.util.caching`` says where the folder is.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import html
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from vecenv.errors import InvalidFile
from vecenv.libero.scene.arenas import ARENAS
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.contacts import Contacts
from vecenv.libero.scene.lean import geometry
from vecenv.libero.scene.scene import Entity, RegionSite, Scene, SceneSource, scene_source
from vecenv.util import caching

# Layout of the two files; raised when it changes.
FORMAT = 2

# Elements are written with double quotes, which are escaped within.
_FILE = re.compile(r' file="([^"]*)"')


class SceneFileError(InvalidFile):
    """A stored scene is missing, damaged, or made by another version of MuJoCo; the message names the file."""


def cached_scene(
    problem: Problem,
    *,
    contact_pairs: Iterable[tuple[str, str]] = (),
    lean_for: Iterable[Problem] | None = None,
    contacts: Contacts = "published",
) -> Scene:
    """The scene of a problem from the cache, or compiled and put there.

    Args:
        problem: a parsed LIBERO problem.
        contact_pairs: as for ``compile_scene``, whose errors this raises.
        lean_for: the tasks to fit lean collision geoms for (``vecenv.libero.scene.lean.geometry``); None keeps
        upstream's.
        contacts: as for ``compile_scene``.
    """
    source, where = scene_source(problem, contact_pairs=contact_pairs, contacts=contacts), caching.folder("scenes")
    asked = None if lean_for is None else geometry.demands(lean_for)
    try:
        key = None if where is None else content_key(source, asked)
    except OSError:  # a file is missing: compiling says which
        key = None
    if where is None or key is None:
        return compiled_source(source, asked)
    try:
        return read_scene(where, key)
    except SceneFileError as error:
        if (where / f"{key}.json").exists() and (where / f"{key}.mjb").exists():
            caching.damaged(where / f"{key}.mjb", str(error))
    scene = compiled_source(source, asked)
    with contextlib.suppress(OSError):
        write_scene(where, key, scene)
    return scene


def compiled_source(source: SceneSource, asked: geometry.Demands | None) -> Scene:
    """The scene with upstream's collision geoms, or with lean ones that meet these demands."""
    return source.compile() if asked is None else geometry.lean_scene(source, asked)


def content_key(source: SceneSource, asked: geometry.Demands | None = None) -> str:
    """Hash of everything that decides a scene's two files, 64 hexadecimal digits; independent of where assets lie.

    Args:
        source: the scene's source.
        asked: demands that lean collision geoms are fitted to; None keeps upstream's.

    Raises:
        OSError: a file that the MJCF refers to cannot be read.
    """
    text = _FILE.sub(_by_content, source.xml)
    parts = [FORMAT, mujoco.__version__, scene_names(source), text]
    if asked is not None:
        parts.append(geometry.lean_key(asked))
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _by_content(attribute: re.Match[str]) -> str:
    """A file attribute with the file's name and digest in the place of its path."""
    path = Path(html.unescape(attribute[1]))
    status = path.stat()
    return f' file="{path.name} {_file_digest(path, status.st_mtime_ns, status.st_size)}"'


@functools.cache
def _file_digest(path: Path, modified: int, size: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def scene_names(scene: Scene | SceneSource) -> dict[str, Any]:
    """Everything in a scene but its model, ready for JSON; ``named_scene`` reads it."""
    return {
        "problem_name": scene.problem_name,
        "entities": [asdict(entity) for entity in scene.entities.values()],
        "regions": [asdict(region) for region in scene.regions.values()],
    }


def write_scene(where: Path, key: str, scene: Scene) -> None:
    """Write a scene's two files into a folder, which is created.

    Raises:
        OSError: they cannot be written.
    """
    buffer = np.zeros(mujoco.mj_sizeModel(scene.model), np.uint8)
    mujoco.mj_saveModel(scene.model, None, buffer)
    names, data = scene_names(scene), buffer.tobytes()
    described = {"format": FORMAT, "mujoco": mujoco.__version__, "sha256": _checksum(data, names), **names}
    where.mkdir(parents=True, exist_ok=True)
    caching.write_file(where / f"{key}.mjb", data)
    caching.write_file(where / f"{key}.json", json.dumps(described, indent=1).encode())


def read_scene(where: Path, key: str) -> Scene:
    """Read a scene from its two files.

    Raises:
        SceneFileError: one is missing or damaged, or they come from another version of MuJoCo.
    """
    path = where / f"{key}.json"
    try:
        described = json.loads(path.read_bytes())
        names = {name: described[name] for name in ("problem_name", "entities", "regions")}
        made_by, checksum = (described["format"], described["mujoco"]), described["sha256"]
        path = path.with_suffix(".mjb")
        found = _checksum(path.read_bytes(), names)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise SceneFileError(f"{path}: damaged: not the description of a scene") from error
    if made_by != (FORMAT, mujoco.__version__):
        raise SceneFileError(
            f"{path}: compiled by MuJoCo {made_by[1]} in layout {made_by[0]}, "
            f"but this is MuJoCo {mujoco.__version__} and layout {FORMAT}"
        )
    if found != checksum:
        raise SceneFileError(f"{path}: damaged: it and {key}.json do not belong together")
    try:
        # From the file, not from the bytes: through MuJoCo's virtual file system it takes four times as long.
        model = mujoco.MjModel.from_binary_path(str(path))
    except (ValueError, mujoco.FatalError) as error:  # gone, or replaced, since it was checked
        raise SceneFileError(f"{path}: cannot be read: {error}") from error
    return named_scene(model, names)


def named_scene(model: mujoco.MjModel, names: Mapping[str, Any]) -> Scene:
    """The scene of a model and what ``scene_names`` returned, also after a way through JSON."""
    entities = [Entity(**_tuples(entity)) for entity in names["entities"]]
    regions = [RegionSite(**_tuples(region)) for region in names["regions"]]
    return Scene(
        problem_name=names["problem_name"],
        model=model,
        arena=ARENAS[names["problem_name"]],
        entities=MappingProxyType({entity.name: entity for entity in entities}),
        regions=MappingProxyType({region.name: region for region in regions}),
    )


def _tuples(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()}


def _checksum(data: bytes, names: Mapping[str, Any]) -> str:
    """Over both files' contents: MuJoCo reads a damaged model without complaint, or crashes."""
    return hashlib.sha256(json.dumps(names).encode() + data).hexdigest()
