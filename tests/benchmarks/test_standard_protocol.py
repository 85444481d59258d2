"""The benchmark of the standard protocol: what its policy says when there is nothing to see."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from standard_protocol import CHUNK, Instant
from support.fakes import FakeEnv

from vecenv.observations import Egocentric

FAULT = "too many contacts"


class Filmed(FakeEnv):
    """Its wrist camera is black while ``dark``."""

    dark = True

    def observe_egocentric(self, slots: Any = None) -> Egocentric:
        images = {name: np.full((self.num_envs, 2, 2, 3), 9, np.uint8) for name in ("agentview", "wrist")}
        images["wrist"] *= not self.dark
        return Egocentric(state=np.zeros((self.num_envs, 8), np.float32), images=images)


def test_black_images_are_an_error_that_says_how_the_slots_stand() -> None:
    env = Filmed([0], range(3), faults={(0, 0): FAULT, (0, 2): FAULT}, faults_in_reset=True)
    env.reset()
    policy = Instant(images=True)
    with pytest.raises(RuntimeError, match=f"^black images of wrist: 1 of 3 slots live, faults: 2 x {FAULT}$"):
        policy.act(env)
    env.dark = False
    np.testing.assert_array_equal(policy.act(env), [CHUNK] * 3)
