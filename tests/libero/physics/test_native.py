"""Groups, blocks and threads of the native backend."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from mujoco.batch import SimulationError

from vecenv.libero.physics import native
from vecenv.libero.physics.base import Start
from vecenv.libero.physics.native import NativePhysics, Workers
from vecenv.libero.scene.scene import Scene, compile_scene
from vecenv.libero.tasks.suites import task

SLOTS = 7
EVERYONE = np.ones(SLOTS, bool)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return compile_scene(task("libero_object", 0).problem())


@pytest.fixture
def placed(scene: Scene) -> NativePhysics:
    return place(scene)


def place(scene: Scene, num_threads: int = 2) -> NativePhysics:
    """Seven stored starts of a task."""
    physics = NativePhysics([scene], np.zeros(SLOTS, int), num_threads)
    states, nq = task("libero_object", 0).init_states()[:SLOTS], scene.model.nq
    none: Any = np.zeros((SLOTS, 0, 4))
    start = Start(
        qpos=states[:, 1 : 1 + nq],
        qvel=states[:, 1 + nq :],
        bodies=np.zeros(0, int),
        body_pos=none[..., :3],
        body_quat=none,
    )
    physics.place(physics.groups[0], np.arange(SLOTS), start)
    return physics


def actions(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (SLOTS, 7))


def test_how_slots_are_cut_into_blocks_does_not_change_a_bit(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for block, threads in ((1, 1), (2, 3), (8, 1), (8, 2)):
        monkeypatch.setattr(native, "BLOCK", block)
        physics = place(scene, threads)
        for seed in range(3):
            physics.control_step(actions(seed), EVERYONE if seed else EVERYONE & (np.arange(SLOTS) != 4))
        group = physics.groups[0]
        found.append([group.state, group.xpos.copy(), physics.eef_pos, physics.eef_quat, physics.fingers])
        physics.close()
    for other in found[1:]:
        for one, same in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(one, same)


@pytest.mark.parametrize(
    ("slots", "threads", "size"), [(1, 2, 1), (2, 2, 1), (8, 2, 4), (20, 2, 5), (64, 2, 8), (64, 1, 8), (65, 4, 6)]
)
def test_blocks_are_small_and_share_out_evenly(slots: int, threads: int, size: int) -> None:
    assert native._block_size(slots, threads) == size


def test_arrays_are_read_only_and_follow_every_call(placed: NativePhysics) -> None:
    group = placed.groups[0]
    contacts, qpos, xpos = group.bind("ncon"), group.qpos.copy(), group.xpos.copy()
    with pytest.raises(ValueError, match="read-only"):
        group.qpos[:] = 0.0
    assert not contacts.any()
    placed.control_step(actions(), EVERYONE)
    assert contacts.all()
    assert contacts is group.bind("ncon")
    assert (np.abs(group.qpos - qpos).max(axis=1) > 0).all()
    assert (np.abs(group.xpos - xpos).max(axis=(1, 2)) > 0).all()
    lagging = group.xpos.copy()
    group.refresh_kinematics()
    assert (np.abs(group.xpos - lagging).max(axis=(1, 2)) > 0).all()
    np.testing.assert_allclose(group.time, 0.05)


def test_slots_that_do_not_move_stay_as_they_are(placed: NativePhysics) -> None:
    placed.control_step(actions(), EVERYONE)
    moving = np.arange(SLOTS) % 3 == 0
    group = placed.groups[0]
    before, eef, fingers = group.state, placed.eef_pos, placed.fingers
    placed.control_step(actions(1), moving)
    np.testing.assert_array_equal(group.state[~moving], before[~moving])
    np.testing.assert_array_equal(placed.eef_pos[~moving], eef[~moving])
    np.testing.assert_array_equal(placed.fingers[~moving], fingers[~moving])
    assert (group.state[moving] != before[moving]).any(axis=1).all()


def test_a_simulation_in_which_mujoco_raises_is_a_fault_of_its_slot(
    placed: NativePhysics, monkeypatch: pytest.MonkeyPatch
) -> None:
    block = placed.groups[0].blocks[1]
    step, calls = block.batch.step, []

    def raises_once(*args: Any, **options: Any) -> None:
        step(*args, **options)
        if not calls:
            calls.append(args)
            raise SimulationError(np.array([1]), "out of luck")

    monkeypatch.setattr(block.batch, "step", raises_once)
    monkeypatch.setattr(block.batch, "error", lambda row: f"error of row {row}")
    placed.control_step(actions(), EVERYONE)
    assert placed.faults == {int(block.slots[1]): "MuJoCo: error of row 1"}
    np.testing.assert_allclose(placed.groups[0].time, 0.05)


def test_workers_call_for_every_item_and_pass_errors_on() -> None:
    workers, seen, meeting = Workers(2), [], threading.Barrier(2)

    def call(item: int) -> None:
        meeting.wait(timeout=30)  # two at a time, or never
        seen.append(item)

    workers.each(call, range(4))
    assert sorted(seen) == [0, 1, 2, 3]
    with pytest.raises(ZeroDivisionError):
        workers.each(lambda item: 1 // item, [1, 0, 1])
    workers.close()
