"""Starts that settle here: fixtures elsewhere than at the centres of their regions."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.physics import settling
from vecenv.libero.physics.base import SETTLE_ACTION
from vecenv.libero.scene.scene import compile_scene
from vecenv.libero.tasks import fixtures, settled, suites
from vecenv.util import caching

SUITE, TASK = "libero_goal", 0


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(caching.VARIABLE, str(tmp_path))
    return tmp_path / "settled"


def make(**options: object) -> LiberoEnv:
    env = vecenv.make(SUITE, task=TASK, episodes=[0, 7], **options)  # type: ignore[arg-type]
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


def central() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The poses of fixtures at the centres of their regions, given one by one."""
    problem = suites.task(SUITE, TASK).problem()
    placements = fixtures.placements(problem, compile_scene(problem))
    return {name: placement.pose(np.full(3, 0.5)) for name, placement in placements.items()}


def test_starts_settled_here_are_those_that_ship(folder: Path) -> None:
    env, shipped = make(fixtures=central()), settled.load(suites.task(SUITE, TASK))
    state = env.state()
    np.testing.assert_allclose(state.qpos, shipped.qpos[[0, 7]], rtol=0, atol=1e-6)
    np.testing.assert_allclose(state.time, settled.TIME)
    assert (env.evaluate().num_steps == 0).all()
    env.close()


def test_nothing_moves_after_settling_with_sampled_fixtures(folder: Path) -> None:
    env = make(fixtures="sampled")
    (group,) = env.physics.groups
    bodies = [group.scene.model.body(entity.root_body).id for entity in group.scene.objects]
    before = np.array(group.xpos[:, bodies])
    env.physics.run(np.tile(SETTLE_ACTION, (2, 30, 1)), np.ones(2, bool), np.full(2, 30))
    group.refresh_kinematics()
    np.testing.assert_allclose(group.xpos[:, bodies], before, atol=2e-3)
    env.close()


def test_a_start_settles_once_and_is_kept_by_content(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = make(fixtures="sampled")
    assert len(list(folder.glob("*.state"))) == 2

    def unexpected(*_: object) -> np.ndarray:
        raise AssertionError("settled again")

    monkeypatch.setattr(settling, "_settle", unexpected)
    again = make(fixtures="sampled")
    np.testing.assert_array_equal(first.state().qpos, again.state().qpos)
    with pytest.raises(AssertionError, match="settled again"):
        make(fixtures="sampled", seed=1)  # other poses are other starts


def test_a_damaged_file_is_settled_again(folder: Path) -> None:
    first = make(fixtures="sampled").state().qpos
    files = sorted(folder.glob("*.state"))
    files[0].write_bytes(b"not an array")
    buffer = io.BytesIO()
    np.save(buffer, np.full(3, np.nan))
    caching.write_file(files[1], caching.sealed(buffer.getvalue()))
    np.testing.assert_array_equal(make(fixtures="sampled").state().qpos, first)


def test_without_a_cache_folder_starts_settle_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(caching.VARIABLE, "")
    env = make(fixtures="sampled")
    assert np.isfinite(env.state().qpos).all()
    env.close()
