"""Warp's kernels are known before they are launched, compiled together, and kept where they can be copied from."""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from vecenv.libero.physics import private
from vecenv.libero.physics.mjx import kernels
from vecenv.util.logs import reported

wp = pytest.importorskip("warp", reason="MuJoCo Warp is an extra: pip install 'vecenv[warp]'")

FALLING = """
<mujoco><worldbody>
  <geom type="plane" size="2 2 .1"/>
  <body pos="0 0 .5"><freejoint/><geom type="sphere" size=".1"/></body>
  <body pos="0 0 .3"><joint type="hinge" axis="0 1 0"/><geom type="capsule" size=".05 .1"/></body>
</worldbody></mujoco>
"""

# A step of a scene; prints which kernels were compiled.
STEP = """
import json, sys
from pathlib import Path
import numpy as np
import warp as wp
import vecenv
from vecenv.libero.physics.mjx import kernels
from vecenv.util import caching

said = []
from vecenv.util.logs import reported
with reported(said.append):
    env = vecenv.make("libero_object", task=0, episodes=[0, 1], backend="warp", geometry="lean")
    env.reset()
    env.step_continuous(np.full((2, 7), 0.5))
    digest = [array.tobytes().hex() for array in (env.state().qpos, env.state().qvel)]
files = sorted(p.name for p in Path(wp.config.kernel_cache_dir).rglob("*.o"))
programs = sorted(p.name for p in caching.folder("jax").rglob("*-cache"))
print(json.dumps([wp.config.kernel_cache_dir, files, programs, said, digest]))
"""


@pytest.fixture
def step() -> tuple[Any, Any, Any]:
    """A function that steps a batch on Warp, and its arguments."""
    kernels.install()
    model = mujoco.MjModel.from_xml_string(FALLING)
    put = mjx.put_model(model, impl="warp")
    data = mjx.make_data(model, impl="warp", naconmax=16, njmax=32)
    return jax.vmap(lambda qpos: mjx.step(put, data.replace(qpos=qpos)).qpos), jnp.tile(data.qpos, (2, 1)), put


def launched_by(monkeypatch: pytest.MonkeyPatch, call: Any) -> set[tuple[int, int]]:
    """Modules and block sizes of the kernels that are loaded while something runs."""
    loaded: set[tuple[int, int]] = set()
    original = wp.Module.load

    def load(module: Any, device: Any, block_dim: int | None = None, **more: Any) -> Any:
        if module.kernels and not getattr(kernels._noting, "here", False):
            loaded.add((id(module), module.options["block_dim"] if block_dim is None else block_dim))
        return original(module, device, block_dim, **more)

    with monkeypatch.context() as patch:
        patch.setattr(wp.Module, "load", load)
        call()
    return loaded


def test_the_kernels_of_a_step_are_known_when_it_is_traced(
    step: tuple[Any, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    function, qpos, _ = step
    noted: list[kernels.Kernels] = []
    original = kernels._noted
    monkeypatch.setattr(kernels, "_noted", lambda *call: noted.extend(found := original(*call)) or found)
    compiled = jax.jit(function).lower(qpos).compile()
    assert noted
    launched = launched_by(monkeypatch, lambda: jax.block_until_ready(compiled(qpos)))
    assert launched
    assert launched <= {(id(each.module), each.block_dim) for each in noted}


def test_noting_changes_nothing(step: tuple[Any, Any, Any]) -> None:
    function, qpos, _ = step
    data = mujoco.MjData(model := mujoco.MjModel.from_xml_string(FALLING))
    mujoco.mj_step(model, data)
    before = wp.Module.load, wp.capture_while, wp.capture_if, wp.utils.array_scan
    fell = np.asarray(jax.jit(function)(qpos))
    assert before == (wp.Module.load, wp.capture_while, wp.capture_if, wp.utils.array_scan)
    np.testing.assert_allclose(fell, np.tile(data.qpos, (2, 1)), atol=1e-5)
    assert not np.allclose(fell, qpos, atol=1e-5)


def test_another_warp_is_said_and_steps_as_ever(
    step: tuple[Any, Any, Any], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    function, qpos, _ = step

    def changed(*args: Any) -> Any:
        raise AttributeError("no input_args")

    monkeypatch.setattr(kernels, "_noted", changed)
    with caplog.at_level(logging.WARNING, "vecenv"):
        fell = np.asarray(jax.jit(function)(jnp.tile(qpos, (2, 1))))  # a batch of a size that was not traced before
    assert np.isfinite(fell).all()
    assert "are compiled one after another when they are launched: AttributeError: no input_args" in caplog.text


def test_what_is_compiled_is_said(tmp_path: Path) -> None:
    counting = [
        kernels.Kernels(made, wp.get_device("cpu"), 1)
        for made in (_module(f"said_{os.getpid()}_{number}", number) for number in range(3))
    ]
    said: list[str] = []
    with reported(said.append):
        assert not any(kernels.is_cached(each) for each in counting)
        kernels.compile_kernels(counting, threads=2)
        assert all(kernels.is_cached(each) for each in counting)
        kernels.compile_kernels([])
    damaged, *others = [kernels._file(each) for each in counting]
    damaged.write_bytes(damaged.read_bytes()[:-100])
    fresh = [each._replace(module=_unloaded(each.module)) for each in counting]
    assert [kernels.is_cached(each) for each in fresh] == [False, True, True]
    assert not damaged.exists()
    assert all(path.exists() for path in others)
    assert said[0] == "compiling 3 kernels of MuJoCo Warp, 2 at once (0 are cached)"
    assert said[-1].startswith("compiled 3 kernels in ")


def _unloaded(module: Any) -> Any:
    """A module as another process sees it: in the cache, and not loaded."""
    module.unload()
    return module


def _module(name: str, number: int) -> Any:
    @wp.kernel(module="unique")
    def kernel(out: wp.array[int]):  # pyright: ignore[reportInvalidTypeForm]
        out[wp.tid()] = wp.static(number + os.getpid())

    kernel.key = name
    return kernel.module


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"VECENV_CACHE_DIR": "cache"}, "cache/warp/"),
        ({"VECENV_CACHE_DIR": "cache", "WARP_CACHE_PATH": "other"}, "other/"),
        ({"VECENV_CACHE_DIR": "", "XDG_CACHE_HOME": "home"}, "home/warp/"),
    ],
)
def test_kernels_are_kept_in_the_cache_folder_unless_another_is_chosen(
    tmp_path: Path, variables: dict[str, str], expected: str
) -> None:
    given = {name: str(tmp_path / value) if value else "" for name, value in variables.items()}
    environment = {name: value for name, value in os.environ.items() if name != "WARP_CACHE_PATH"} | given
    code = "from vecenv.libero.physics.mjx import kernels; kernels.choose_cache(); import warp as wp; wp.init(); "
    done = subprocess.run(
        [sys.executable, "-c", code + "print(wp.config.kernel_cache_dir)"],
        capture_output=True,
        text=True,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == f"{tmp_path}/{expected}{wp.config.version}"


PROGRAM = """
import jax
from vecenv.libero.physics.mjx.options import remember_compilations
from vecenv.util import caching

remember_compilations()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.jit(lambda x: x * 2 + 1)(1.0)
print(sorted(path.name for path in caching.folder("jax").glob("*-cache")))
"""


def test_the_keys_of_programs_do_not_depend_on_where_the_cache_lies(tmp_path: Path) -> None:
    names = []
    for place in ("here", "there"):
        environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
        environment["VECENV_CACHE_DIR"] = str(tmp_path / place)
        done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        names.append(done.stdout.splitlines()[-1])
    assert "jit" in names[0]
    assert names[0] == names[1]


@pytest.mark.heavy
def test_a_copied_cache_leaves_nothing_to_compile(tmp_path: Path) -> None:
    def run(cache: Path) -> tuple[list[str], list[str], list[str], list[str]]:
        environment = {name: value for name, value in os.environ.items() if name != "WARP_CACHE_PATH"}
        environment["VECENV_CACHE_DIR"] = str(cache)
        done = subprocess.run([sys.executable, "-c", STEP], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        folder, *found = json.loads(done.stdout.splitlines()[-1])
        assert Path(folder).is_relative_to(cache)
        return tuple(found)

    first = run(tmp_path / "first")
    shutil.move(tmp_path / "first", tmp_path / "moved")
    second = run(tmp_path / "moved")
    assert len(first[0]) > 50
    assert any("compiled" in text for text in first[2])
    assert second[:2] == first[:2]  # no kernel and no program more
    assert not any("kernels" in text or "memory" in text for text in second[2])
    assert second[3] == first[3]


def test_the_private_name_is_there() -> None:
    assert callable(private.FfiCallable.__call__)
