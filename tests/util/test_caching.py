"""What is damaged in a cache is made again with a warning, whatever happened to it."""

from __future__ import annotations

import importlib.util
import logging
import pickle
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pytest
from numba import types

from vecenv.util import caching, compiled

SOURCE = """
def twice(x):
    return 2 * x + 1
"""


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(bytes(data))


def junk(path: Path) -> None:
    path.write_bytes(pickle.dumps(("0.0", [])) + b"junk")


DAMAGE = [cut, empty, flip, junk]


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    settings: Any = numba.config  # pyright: ignore[reportPrivateImportUsage]
    monkeypatch.setattr(settings, "CACHE_DIR", str(tmp_path / "numba"))
    path = tmp_path / "doubling.py"
    path.write_text(SOURCE)
    spec = importlib.util.spec_from_file_location("doubling", path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def run(module: ModuleType) -> float:
    call: Any = compiled.compile_function(types.float64(types.float64), module.twice)
    return call(3.0)


@pytest.mark.parametrize("which", ["*.nbi", "*.nbc", "*.sha256"])
@pytest.mark.parametrize("damage", DAMAGE)
def test_compiled_code_that_was_changed_is_not_run(
    module: ModuleType, tmp_path: Path, caplog: pytest.LogCaptureFixture, which: str, damage: Callable[[Path], None]
) -> None:
    assert run(module) == 7.0
    assert not caplog.records
    (path,) = (tmp_path / "numba").rglob(which)
    damage(path)
    with caplog.at_level(logging.WARNING):
        assert run(module) == 7.0
    assert "cannot be used" in caplog.text
    caplog.clear()
    assert len(list((tmp_path / "numba").rglob(which))) == 1
    assert run(module) == 7.0
    assert not caplog.records


def test_compiled_code_is_read_from_the_cache(module: ModuleType, tmp_path: Path) -> None:
    run(module)
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "numba").rglob("*.nb*")}
    run(module)
    assert len(files) == 2
    assert {path: path.stat().st_mtime_ns for path in files} == files


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_sealed_file_that_was_changed_is_none(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: Callable[[Path], None]
) -> None:
    path = tmp_path / "file"
    assert caching.unsealed(path) is None
    assert not caplog.records
    caching.write_file(path, caching.sealed(np.arange(9).tobytes()))
    assert caching.unsealed(path) == np.arange(9).tobytes()
    damage(path)
    assert caching.unsealed(path) is None
    assert f"{path}: cannot be used" in caplog.text
