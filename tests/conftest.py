"""Settings and fixtures shared by all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import jax
import jaxtyping
import platformdirs
import pytest
from hypothesis import settings
from support import checker, memory

# Tests check the shapes and types in the signatures of these modules, which must not have been imported yet. Left out
# are modules that numba compiles, and dataclasses that JAX fills with things other than arrays while it traces.
_CONTROLLERS = ("_batch_last", "chain", "gripper", "interpolate", "joint", "kinematics", "osc", "waypoint")
_FUNCTIONAL = ("config", "env", "objectives", "observer", "physics", "randomize", "starts")
_PLANNING = ("config", "maps", "plan", "planner", "push")
_CHECKED = [
    *(f"vecenv.controllers.{name}" for name in _CONTROLLERS),
    *(f"vecenv.libero.functional.{name}" for name in _FUNCTIONAL),
    *(f"voxposer.planning.{name}" for name in _PLANNING),
]
jaxtyping.install_import_hook(_CHECKED, f"{checker.__name__}.{checker.check.__name__}")

# How long an example takes says something about the machine, nothing about the code.
settings.register_profile("vecenv", deadline=None)
settings.load_profile("vecenv")

memory.map_large_allocations()

REPOSITORY = Path(__file__).parent.parent
# Bytes of compiled JAX programs that are kept; those used longest ago are dropped first.
LARGEST_CACHE = 2 * 2**30
# Files that take long.
LONGEST = (
    "libero/physics/test_mjx.py",
    "libero/functional/test_functional.py",
    "libero/physics/test_deterministic.py",
    "interop/test_playground.py",
    "libero/render/test_raytrace.py",
    "libero/render/test_rays.py",
    "libero/physics/test_mjx_contacts.py",
    "test_examples.py",
    "eval/test_verdict_identity.py",
)


@pytest.fixture(scope="session", autouse=True)
def _cache_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What is compiled goes to a folder of this run, not to the user's cache. Warp's kernels take minutes and do not.

    The processes of a run share the folder. JAX locks its part of it only where that has a largest size.
    """
    run = tmp_path_factory.getbasetemp()
    folder = (run.parent if "PYTEST_XDIST_WORKER" in os.environ else run) / "vecenv-cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VECENV_CACHE_DIR", str(folder))
        patch.setenv("JAX_COMPILATION_CACHE_MAX_SIZE", str(LARGEST_CACHE))
        jax.config.update("jax_compilation_cache_dir", str(folder / "jax"))
        jax.config.update("jax_compilation_cache_max_size", LARGEST_CACHE)
        jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
        if "WARP_CACHE_PATH" not in os.environ:
            patch.setenv("WARP_CACHE_PATH", str(platformdirs.user_cache_path("warp")))
        yield


@pytest.fixture(scope="module", autouse=True)
def _memory_is_given_back() -> Iterator[None]:
    """A process does not keep what the files before have compiled and freed."""
    yield
    memory.give_back()


@pytest.fixture(scope="module")
def no_rank_promotion() -> Iterator[None]:
    """Arrays of different rank do not broadcast (MJX itself relies on that, so this is not for all tests)."""
    with jax.numpy_rank_promotion("raise"):
        yield


@pytest.fixture(scope="module")
def quick_compilation() -> Iterator[None]:
    """JAX's programs are not optimised: for files whose programs take longer to compile than to run."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def unchecked_shapes() -> Iterator[None]:
    """Signatures are not checked, as outside of tests: a wrong shape reaches the function, whose own error counts."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def repository() -> Path:
    """The clone these tests lie in."""
    return REPOSITORY


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small generated asset tree for SIMPLER; not to be written to."""
    from support import simpler_assets_small

    return simpler_assets_small.build(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="session")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SIMPLER's own assets without what is only drawn; skips the test where there is no archive of them."""
    from support.simpler_files import physics_files

    return physics_files(tmp_path_factory.mktemp("original"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take longest come first, so that the processes that share the files end together."""
    place = {REPOSITORY / "tests" / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path, len(place)))
