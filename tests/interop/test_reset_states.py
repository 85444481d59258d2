"""The order of RLinf's reset states: first and second draw of four, recorded from RLinf's own methods (a3816b5)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vecenv.interop.reset_states import ResetStateError, ResetStates

ORDERED: dict[str, Any] = {"ordered": True}
EVALUATION: dict[str, Any] = {"evaluating": True}
SECOND_OF_THREE = {"rank": 1, "processes": 3}


@pytest.mark.parametrize(
    ("options", "first", "second"),
    [
        ({}, [335, 402, 11, 403], [234, 257, 315, 142]),
        (ORDERED, [221, 434, 109, 334], [375, 71, 378, 205]),
        ({**ORDERED, **SECOND_OF_THREE}, [229, 159, 128, 367], [198, 492, 10, 272]),
        ({**EVALUATION, **SECOND_OF_THREE}, [50, 200, 350, 1], [151, 301, 451, 102]),
        ({"tasks": [3, 1]}, [167, 180, 52, 180], [96, 151, 163, 78]),
        ({**EVALUATION, "tasks": [3, 1]}, [50, 51, 52, 53], [54, 55, 56, 57]),
    ],
)
def test_ids_come_in_rlinfs_order(options: dict[str, Any], first: list[int], second: list[int]) -> None:
    states = ResetStates(num_tasks=10, seed=5, **options)
    assert states.draw(4).tolist() == first
    assert states.draw(4).tolist() == second


def test_an_evaluation_goes_through_every_id_once_over_all_processes() -> None:
    drawn = np.concatenate([ResetStates(num_tasks=2, evaluating=True, rank=r, processes=3).draw(50) for r in range(3)])
    assert sorted(drawn[drawn >= 0].tolist()) == list(range(100))
    states = ResetStates(num_tasks=1, evaluating=True)
    states.draw(50)
    assert states.draw(2).tolist() == [-1, -1]
    states.rewind()
    assert states.draw(2).tolist() == [0, 1]


def test_an_id_is_an_episode_of_a_task_and_others_are_refused() -> None:
    states = ResetStates(num_tasks=10)
    tasks, episodes = states.split(np.array([0, 49, 50, 499]))
    assert (tasks.tolist(), episodes.tolist()) == ([0, 0, 1, 9], [0, 49, 0, 49])
    with pytest.raises(ResetStateError, match="500 does not exist; there are 0 to 499"):
        states.split(np.array([500]))
    with pytest.raises(ResetStateError, match="more environments than reset states"):
        states.split(np.array([-1]))
    with pytest.raises(ResetStateError, match="task_id_filter: 10"):
        ResetStates(num_tasks=10, tasks=[10])
