"""Recordings copied from one of our HDF5 files to another."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection
from pathlib import Path

import h5py

from vecenv_eval.demos.hdf5 import Errors, Opened, member


def copy_demos(source: Path, target: Path, episodes: Collection[int]) -> None:
    """Copy recordings to another file, which is replaced in one step, or made.

    Args:
        source, target: files of the same task.
        episodes: which episodes; those without a recording are passed over, those that are there are replaced.

    Raises:
        DemoError: a file cannot be read.
    """
    with Opened(source) as file, Errors(source):
        found = member(file, "data", h5py.Group)
        names = [name for name in (f"demo_{episode}" for episode in sorted(episodes)) if name in found]
        if not names:
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(target.name + ".tmp")
        temporary.unlink(missing_ok=True)
        if target.exists():
            shutil.copyfile(target, temporary)
        with h5py.File(temporary, "a") as copy:
            data = copy.require_group("data")
            for name, value in found.attrs.items():
                data.attrs[name] = value
            for name in names:
                if name in data:
                    del data[name]
                file.copy(member(found, name, h5py.Group), data, name=name)
            data.attrs["num_demos"] = len(data)
            data.attrs["total"] = sum(int(group.attrs["num_samples"]) for group in data.values())
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        temporary.replace(target)
