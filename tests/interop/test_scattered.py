"""Slots change to any task while others continue, and what continues is what it would have been."""

from __future__ import annotations

from typing import Any

import numpy as np

from vecenv.interop.scattered import ScatteredBatch

SUITE, COUNT = "libero_object", 3
FIELDS: dict[str, Any] = {"success": "final", "max_steps": 1000, "render": {"height": 16, "width": 16}}


def ints(*values: int) -> np.ndarray:
    return np.array(values)


def actions(ticks: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (ticks, COUNT, 7))


def test_slots_that_continue_do_not_notice_others_moving_to_other_scenes() -> None:
    moved, still = (ScatteredBatch(SUITE, COUNT, FIELDS) for _ in range(2))
    for batch in (moved, still):
        batch.begin(np.arange(COUNT), ints(0, 0, 2), ints(4, 5, 6))
        assert batch.num_batches == 1
    for tick, action in enumerate(actions(6)):
        if tick == 2:
            moved.begin(ints(1), ints(3), ints(7))
            assert moved.num_batches == 2
        moved.step(action)
        still.step(action)
    ours, theirs = moved.observe(), still.observe()
    for slot in (0, 2):
        np.testing.assert_array_equal(ours.state[slot], theirs.state[slot])
        np.testing.assert_array_equal(ours.images["agentview"][slot], theirs.images["agentview"][slot])
    assert not np.array_equal(ours.images["agentview"][1], theirs.images["agentview"][1])
    assert moved.instructions()[1] != still.instructions()[1]
    moved.close()
    still.close()


def test_a_slot_that_moved_is_as_one_that_began_there_and_all_together_are_one_batch() -> None:
    moved, direct = (ScatteredBatch(SUITE, COUNT, FIELDS) for _ in range(2))
    moved.begin(np.arange(COUNT), ints(0, 0, 0), ints(1, 2, 3))
    moved.begin(ints(2, 0), ints(1, 0), ints(9, 8))
    assert moved.num_batches == 2
    direct.begin(np.arange(COUNT), ints(0, 0, 1), ints(8, 2, 9))
    for action in actions(3):
        moved.step(action)
        direct.step(action)
    np.testing.assert_array_equal(moved.observe().state, direct.observe().state)
    moved.begin(np.arange(COUNT), ints(1, 1, 0), ints(0, 1, 2))
    assert moved.num_batches == 1
    moved.close()
    direct.close()
    moved.close()
