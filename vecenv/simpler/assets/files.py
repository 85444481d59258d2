"""Paths of SIMPLER's meshes, images and robot descriptions, and stand-ins for missing files.

In: the asset tree, in upstream's own layout (``data/...`` and ``mani_skill2_real2sim/...`` of ManiSkill2_real2sim):
the folder that ``VECENV_SIMPLER_ASSETS`` names, else the user's data folder, which ``vecenv assets pull simpler``
fills. Out: ``resolve`` and ``visual_mesh``, paths of files, or a ``StandIn`` where a file is missing that a plain shape
can replace; its ``note`` tells the user. ``manifest.json`` lists the files with their hashes,
``manifest_variants.json`` those that only variant aggregation needs; both are written by
``scripts/simpler_manifest.py``. Downloading is in ``pull.py``.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import platformdirs

from vecenv.assets import AssetRow, AssetsMissing
from vecenv.errors import InvalidFile

VARIABLE = "VECENV_SIMPLER_ASSETS"
NAME = "SIMPLER meshes, images and robots"
HOW_TO_GET = "vecenv assets pull simpler"
HOW_TO_GET_VARIANTS = "vecenv assets pull simpler-variants"
MANIFEST = Path(__file__).with_name("manifest.json")
VARIANTS_MANIFEST = Path(__file__).with_name("manifest_variants.json")
_MARKERS = ("data/custom", "mani_skill2_real2sim/assets/descriptions")
_STAGES = PurePosixPath("data/hab2_bench_assets/stages")
_MODELS = PurePosixPath("data/custom/models")
# Upstream's order.
_VISUALS = ("textured.obj", "textured.dae", "textured.glb")


class ManifestError(InvalidFile):
    """The list of files is damaged or names a path outside the tree; the message says which."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A file of the tree.

    Attributes:
        path: relative to the tree's root.
        size: bytes, None where the file could not be had when the list was made.
        sha256: of its content, hexadecimal; "" if not known.
        git_blob: Git's identifier of its content (SHA-1 of a header and the content); "" if not known.
        used_by: the only file that needs it, None where the simulator opens it itself.
    """

    path: PurePosixPath
    size: int | None = None
    sha256: str | None = None
    git_blob: str = ""
    used_by: PurePosixPath | None = None

    @property
    def key(self) -> str:
        """Identifier of its content."""
        return self.sha256 or self.git_blob

    def matches(self, file: Path) -> bool:
        """Whether a file has this content; False when it does not exist."""
        try:
            size = file.stat().st_size
        except OSError:
            return False
        if self.size not in (None, size):
            return False
        return file_digest(file) == self.sha256 if self.sha256 else _git_blob(file, size) == self.git_blob


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """The files of the tree.

    Attributes:
        commit: of ManiSkill2_real2sim, where they come from.
        files: in the order of their paths.
    """

    commit: str
    files: tuple[Entry, ...]

    @functools.cached_property
    def by_path(self) -> dict[PurePosixPath, Entry]:
        """Path -> entry."""
        return {entry.path: entry for entry in self.files}


def read_manifest(path: Path = MANIFEST) -> Manifest:
    """The list of files.

    Raises:
        ManifestError: it is missing, damaged, or has a path that leads out of the tree.
    """
    try:
        stored = json.loads(path.read_bytes())
        files = tuple(_entry(row) for row in stored["files"])
        return Manifest(commit=str(stored["commit"]), files=files)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ManifestError(f"{path}: {error}") from error


def _entry(row: dict[str, object]) -> Entry:
    size, sha256 = row.get("size"), row.get("sha256")
    entry = Entry(
        path=safe_path(str(row["path"])),
        size=int(str(size)) if size is not None else None,
        sha256=str(sha256) if sha256 is not None else None,
        git_blob=str(row.get("git_blob", "")),
        used_by=safe_path(str(row["used_by"])) if "used_by" in row else None,
    )
    if not entry.key:
        raise ValueError(f"{entry.path} has no hash")
    return entry


def safe_path(text: str) -> PurePosixPath:
    """A relative path that does not leave its folder, with forward slashes.

    Raises:
        ManifestError: it is absolute, empty, or has parts like ``..``.
    """
    parts = text.split("/")
    if not text or "\\" in text or ":" in text or "\0" in text or any(part in ("", ".", "..") for part in parts):
        raise ManifestError(f"{text!r} is not a relative path inside the tree")
    return PurePosixPath(*parts)


def file_digest(file: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _git_blob(file: Path, size: int) -> str:
    digest = hashlib.sha1(b"blob %d\0" % size, usedforsecurity=False)
    with file.open("rb") as stream:
        while chunk := stream.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


# ---------------------------------------------------------------------------------------------------------------------
# The tree.


def default_root() -> Path:
    """Folder that ``vecenv assets pull simpler`` fills by default."""
    named = os.environ.get(VARIABLE)
    return Path(named).expanduser() if named else platformdirs.user_data_path("vecenv") / "simpler"


def simpler_root(given: str | Path | None = None) -> Path:
    """Root of the tree: ``given``, or ``default_root()``.

    Raises:
        AssetsMissing: there is no tree.
    """
    root = default_root() if given is None else Path(given).expanduser()
    absent = [marker for marker in _MARKERS if not (root / marker).is_dir()]
    if not absent:
        return root
    where = f"{VARIABLE}={str(root)!r}" if given is None and os.environ.get(VARIABLE) else str(root)
    problem = f"{where} has no {absent[0]}" if root.is_dir() else f"{where} is not a directory"
    fix = f"{HOW_TO_GET}, or point {VARIABLE} at a folder with {' and '.join(_MARKERS)}"
    raise AssetsMissing(NAME, problem, fix)


def asset_row() -> AssetRow:
    """One row for ``vecenv doctor``; never raises. ``stand_ins`` lists the missing files of a usable tree."""
    try:
        root = simpler_root()
    except AssetsMissing as error:
        return AssetRow(NAME, None, False, error.how_to_get, error.problem)
    return AssetRow(NAME, root, True)


# ---------------------------------------------------------------------------------------------------------------------
# Files and their stand-ins.


@dataclass(frozen=True, kw_only=True)
class StandIn:
    """A plain shape in place of a missing file.

    Attributes:
        kind: ``table`` (a box whose upper face is at ``top``) or ``mesh`` (draw the file ``mesh``).
        top: metres, world frame.
        mesh: a file.
        note: one sentence: what is missing, what is there instead, and how sure that is.
    """

    kind: str
    top: float = 0.0
    mesh: Path | None = None
    note: str


@dataclass(frozen=True, kw_only=True)
class Resolved:
    """Either a file or its stand-in, the other is None."""

    path: Path | None = None
    stand_in: StandIn | None = None

    @property
    def note(self) -> str:
        """Note for the user, "" if the file exists."""
        return self.stand_in.note if self.stand_in else ""


@dataclass(frozen=True, kw_only=True)
class _Table:
    """Height of a stage's table, metres; ``proof``: the evidence for it."""

    top: float
    proof: str


# Found by dropping objects on boxes until they rested where upstream's published resets have them.
_TABLES = {
    "bridge_table_1_v1": _Table(top=0.869532, proof="it reproduces published resting poses"),
    "bridge_table_1_v2": _Table(top=0.869532, proof="assumed equal to bridge_table_1_v1's, unverified"),
    "google_pick_coke_can_1_v4": _Table(top=0.887532, proof="it reproduces published resting poses"),
}


def resolve(name: str | PurePosixPath, root: Path | None = None) -> Resolved:
    """A file of the tree, or its stand-in.

    Args:
        name: path relative to the root.
        root: of the tree; ``simpler_root()`` by default.

    Raises:
        AssetsMissing: the file is missing and has no stand-in.
        ManifestError: the path leads out of the tree.
    """
    path, tree = safe_path(str(name)), root or simpler_root()
    if (tree / path).is_file():
        return Resolved(path=tree / path)
    if path.parent == _STAGES and path.stem in _TABLES:
        return Resolved(stand_in=_table(path))
    if path.parent.parent == _MODELS and path.name in _VISUALS and (tree / path.parent / "collision.obj").is_file():
        return Resolved(stand_in=_bare_mesh(path, tree))
    raise AssetsMissing(NAME, f"{tree} has no {path}", how_to_get(path))


def how_to_get(path: PurePosixPath) -> str:
    """The command that fetches a file of the tree."""
    return HOW_TO_GET_VARIANTS if path in read_manifest(VARIANTS_MANIFEST).by_path else HOW_TO_GET


def collision_mesh(model: str, root: Path | None = None) -> Path:
    """Convex parts of an object.

    Raises:
        AssetsMissing: the object has no collision mesh.
    """
    found = resolve(_MODELS / model / "collision.obj", root).path
    assert found is not None  # it has no stand-in, so it exists
    return found


def visual_mesh(model: str, root: Path | None = None) -> Resolved:
    """The rendered mesh of an object: its textured mesh, or a stand-in.

    Raises:
        AssetsMissing: the object has not even a collision mesh.
    """
    tree = root or simpler_root()
    for name in _VISUALS:
        if (tree / _MODELS / model / name).is_file():
            return Resolved(path=tree / _MODELS / model / name)
    return resolve(_MODELS / model / _listed_visual(model), tree)


def stand_ins(root: Path | None = None) -> tuple[str, ...]:
    """Notes of all stand-ins that SIMPLER's tasks would use with this tree."""
    tree = root or simpler_root()
    absent = [entry.path for entry in read_manifest().files if not (tree / entry.path).is_file()]
    return tuple(note for path in absent if (note := stand_in_note(path, tree)))


def stand_in_note(path: PurePosixPath, tree: Path) -> str:
    """The note of a missing file's stand-in, "" if the file exists or has no stand-in."""
    try:
        return resolve(path, tree).note
    except AssetsMissing:
        return ""


def _table(path: PurePosixPath) -> StandIn:
    table = _TABLES[path.stem]
    note = f"{path} is missing: a plain table with its top at z = {table.top} m stands in ({table.proof})"
    return StandIn(kind="table", top=table.top, note=note)


def _bare_mesh(path: PurePosixPath, tree: Path) -> StandIn:
    note = f"{path} is missing: the object is drawn as its collision mesh, without texture"
    return StandIn(kind="mesh", mesh=tree / path.parent / "collision.obj", note=note)


def _listed_visual(model: str) -> str:
    names = [path.name for path in read_manifest().by_path if path.parent == _MODELS / model]
    return next((name for name in _VISUALS if name in names), _VISUALS[1])
