"""Recordings copied from one of our HDF5 files to another."""

from __future__ import annotations

import io
import os
from collections.abc import Collection, Sequence
from pathlib import Path

import h5py

from vecenv_eval.demos.hdf5 import Errors, Opened, attribute, member, numeric_dataset
from vecenv_eval.demos.reader import READER
from vecenv_eval.store.files import replace_bytes, sync_folder


def copy_demos(source: Path, target: Path, episodes: Collection[int]) -> None:
    """Copy recordings to another file, which is replaced in one step, or made.

    Args:
        source, target: files of the same task.
        episodes: which episodes; those without a recording are passed over, those that are there are replaced.

    Raises:
        DemoError: a file cannot be read.
        OSError: the target cannot be written.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    made = target.with_name(target.name + ".new")
    made.unlink(missing_ok=True)
    names = [f"demo_{episode}" for episode in sorted(episodes)]
    answer = READER.ask(source, "copy", target=str(target.absolute()), out=str(made.absolute()), names=names)
    if error := answer.content["copied"]:
        raise OSError(*error)
    if made.exists():
        made.replace(target)
        sync_folder(target.parent)


def copy_here(source: Path, target: Path, out: Path, names: Sequence[str]) -> list[object]:
    """Write the target with the recordings of these names to another file, in this process; none are no file.

    Gives the arguments of an ``OSError`` if the file cannot be written, else [].
    """
    with Opened(source) as file, Errors(source):
        found = member(file, "data", h5py.Group)
        chosen = [name for name in names if name in found]
        if not chosen:
            return []
        image = io.BytesIO(target.read_bytes() if target.exists() else b"")
        with h5py.File(image, "a") as copy:
            data = copy.require_group("data")
            for name in found.attrs:
                data.attrs[name] = attribute(found, name)
            for name in chosen:
                group = member(found, name, h5py.Group)
                for inner in group:
                    numeric_dataset(group, str(inner))  # nothing that lies elsewhere is copied
                if name in data:
                    del data[name]
                file.copy(group, data, name=name)
            data.attrs["num_demos"] = len(data)
            data.attrs["total"] = sum(int(group.attrs["num_samples"]) for group in data.values())
    try:
        replace_bytes(out, image.getvalue())
    except OSError as error:
        return [error.errno, error.strerror or os.strerror(error.errno or 0), str(out)]
    return []
