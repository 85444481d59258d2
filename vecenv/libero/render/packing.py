"""Compiled models in pieces: textures and meshes are files that models share, the rest is a file of each model.

In: a model with its visual meshes. Out: files in one folder and, ready for JSON, the list of those that make up the
model; ``read`` puts it together again: every array as it was, but for the bounding volumes inside meshes. Two scenes
have the same robot and mostly the same floor, walls and objects, so 32 of them take little more room than the things
that occur in them.

The name of a file is the SHA-256 of its contents before compression, so what is there is never written twice, and a
damaged file is found when it is read. Contents are differences between rows, byte by byte of their numbers, deflated.
"""

from __future__ import annotations

import copy
import hashlib
import itertools
import zlib
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from vecenv.errors import InvalidFile
from vecenv.util import caching
from vecenv.util.cores import usable_cores

# Arrays whose parts are files, the type of their numbers, and the array that has the rows where their parts begin.
_PACKED: Mapping[str, tuple[type[np.number], str]] = {
    "tex_data": (np.uint8, "tex_adr"),
    "mesh_vert": (np.float32, "mesh_vertadr"),
    "mesh_normal": (np.float32, "mesh_normaladr"),
    "mesh_texcoord": (np.float32, "mesh_texcoordadr"),
    "mesh_face": (np.int32, "mesh_faceadr"),
    "mesh_facenormal": (np.int32, "mesh_faceadr"),
    "mesh_facetexcoord": (np.int32, "mesh_faceadr"),
    "mesh_polymapadr": (np.int32, "mesh_vertadr"),
    "mesh_polymapnum": (np.int32, "mesh_vertadr"),
}
# Arrays with the bounding volumes inside meshes, which nothing that draws reads: 40 % of the bytes. Left 0.
_DROPPED = ("bvh_aabb", "bvh_child", "bvh_nodeid", "bvh_depth")
# Parts with fewer bytes stay with the rest.
_LEAST = 16_384
# Bytes of a block of the rest; blocks of zeros, in the places of the parts, are left out.
_BLOCK = 4096


class PackingError(InvalidFile):
    """A file of a packed model is missing or damaged; the message names it."""


class Pieces:
    """A folder of packed models.

    Args:
        folder: created when the first model is written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._sound: set[str] = set()

    def write(self, model: mujoco.MjModel) -> dict[str, Any]:
        """Write the files of a model that are not there yet, or damaged; returns the list of them, ready for JSON.

        Raises:
            OSError: one cannot be written.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        rest, parts = copy.copy(model), list(_parts(model))
        for name, start, stop in parts:
            getattr(rest, name)[start:stop] = 0
        for name in _DROPPED if (rest.mesh_bvhadr >= 0).any() else ():
            getattr(rest, name)[rest.mesh_bvhadr[rest.mesh_bvhadr >= 0].min() :] = 0
        buffer = np.zeros(mujoco.mj_sizeModel(rest), np.uint8)
        mujoco.mj_saveModel(rest, None, buffer)
        contents = [_shaped(model, *part) for part in parts]
        with ThreadPoolExecutor(usable_cores()) as threads:
            rest_key, *keys = threads.map(self._put, [_without_zeros(buffer), *contents])
        listed = [(*part, rows.shape[1], key) for part, rows, key in zip(parts, contents, keys, strict=True)]
        return {"bytes": len(buffer), "rest": rest_key, "parts": listed}

    def read(self, listed: Mapping[str, Any]) -> mujoco.MjModel:
        """Put a model together.

        Args:
            listed: what ``write`` returned, also after a way through JSON.

        Raises:
            PackingError: a file is missing or damaged, or MuJoCo does not read the model.
        """
        buffer = _with_zeros(self._get(listed["rest"], 1, np.uint8), listed["bytes"])
        try:
            model = mujoco.MjModel.from_binary_path("model", {"model": buffer.tobytes()})
        except (ValueError, mujoco.FatalError) as error:
            raise PackingError(f"{self._folder / listed['rest']}: MuJoCo cannot read it: {error}") from error

        def fill(part: tuple[str, int, int, int, str]) -> None:
            name, start, stop, width, key = part
            _shaped(model, name, start, stop)[:] = self._get(key, width, _PACKED[name][0])

        with ThreadPoolExecutor(usable_cores()) as threads:
            list(threads.map(fill, listed["parts"]))
        return model

    def check(self, listed: Mapping[str, Any]) -> None:
        """Check that all files of a model are whole; each is read once in the life of this object.

        Raises:
            PackingError: one is missing or damaged.
        """
        wanted = [(listed["rest"], 1, np.uint8)]
        wanted += [(key, width, _PACKED[name][0]) for name, _, _, width, key in listed["parts"]]
        unknown = [each for each in wanted if each[0] not in self._sound]
        with ThreadPoolExecutor(usable_cores()) as threads:
            list(threads.map(lambda each: self._get(*each), unknown))
        self._sound |= {key for key, *_ in unknown}

    def sizes(self, listed: Mapping[str, Any]) -> dict[str, int]:
        """Bytes of the files of a model, by name.

        Raises:
            OSError: one is missing.
        """
        names = [listed["rest"], *(part[-1] for part in listed["parts"])]
        return {name: (self._folder / name).stat().st_size for name in names}

    def _put(self, rows: np.ndarray) -> str:
        """Write an array [n, k] unless it is there; returns the name of its file."""
        key, path = _key(rows), self._folder / _key(rows)
        if key not in self._sound:
            try:
                self._get(key, rows.shape[1], rows.dtype)
            except PackingError:
                caching.write_file(path, zlib.compress(_differences(rows)))
            self._sound.add(key)
        return key

    def _get(self, key: str, width: int, kind: npt.DTypeLike) -> np.ndarray:
        """The array [n, width] of a file."""
        path = self._folder / key
        try:
            rows = _sums(zlib.decompress(path.read_bytes()), width, np.dtype(kind))
        except OSError as error:
            raise PackingError(f"{path}: cannot be read: {error.strerror}") from error
        except (ValueError, zlib.error) as error:
            raise PackingError(f"{path}: damaged") from error
        if _key(rows) != key:
            raise PackingError(f"{path}: damaged: its contents are not those of its name")
        return rows


def _parts(model: mujoco.MjModel) -> Iterator[tuple[str, int, int]]:
    """Parts of the model that are files: array, first row, row after the last."""
    for name, (_, starts) in _PACKED.items():
        array = getattr(model, name)
        begins = np.unique(getattr(model, starts))
        begins = begins[begins >= 0].tolist()
        for start, stop in itertools.pairwise([*begins, len(array)]):
            if array[start:stop].nbytes >= _LEAST:
                yield name, start, stop


def _shaped(model: mujoco.MjModel, name: str, start: int, stop: int) -> np.ndarray:
    """A view of a part of an array, [n, k]; of a texture, a texel a row."""
    rows = getattr(model, name)[start:stop]
    if name == "tex_data":
        return rows.reshape(-1, int(model.tex_nchannel[np.flatnonzero(model.tex_adr == start)[0]]))
    return rows.reshape(stop - start, -1)


def _key(rows: np.ndarray) -> str:
    """SHA-256 of the contents and shape of an array [n, k], 64 hexadecimal digits."""
    digest = hashlib.sha256(f"{rows.dtype.str} {rows.shape[1]} ".encode())
    digest.update(np.ascontiguousarray(rows).data)
    return digest.hexdigest()


def _differences(rows: np.ndarray) -> bytes:
    """Differences between an array's rows [n, k] as whole numbers: all their first bytes, all their second ones, ..."""
    words = np.ascontiguousarray(rows).view(f"<u{rows.dtype.itemsize}")
    steps = np.diff(words, axis=0, prepend=words[:1] * 0)
    return steps.view(np.uint8).reshape(-1, rows.dtype.itemsize).T.tobytes()


def _sums(data: bytes, width: int, dtype: np.dtype) -> np.ndarray:
    """The array [n, width] whose ``_differences`` these are.

    Raises:
        ValueError: they are those of an array of another shape.
    """
    size = dtype.itemsize
    steps = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(size, -1).T).view(f"<u{size}")
    words = np.cumsum(steps.reshape(-1, width), axis=0, dtype=f"<u{size}")
    return words.view(dtype)


def _without_zeros(buffer: np.ndarray) -> np.ndarray:
    """The blocks [n, 1] of some bytes that are not all 0, after a bit for each block that says whether it is."""
    blocks = np.pad(buffer, (0, -len(buffer) % _BLOCK)).reshape(-1, _BLOCK)
    kept = blocks.any(axis=1)
    return np.concatenate([np.packbits(kept), blocks[kept].ravel()])[:, None]


def _with_zeros(packed: np.ndarray, size: int) -> np.ndarray:
    """The bytes [size] of which ``_without_zeros`` made these."""
    count = -(-size // _BLOCK)
    bits = -(-count // 8)
    blocks = np.zeros((count, _BLOCK), np.uint8)
    blocks[np.unpackbits(packed[:bits, 0], count=count).astype(bool)] = packed[bits:, 0].reshape(-1, _BLOCK)
    return blocks.ravel()[:size]
