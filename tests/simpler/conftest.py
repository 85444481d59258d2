"""Asset trees and environments shared by the tests of SIMPLER."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from vecenv.simpler.env import SimplerEnv


@pytest.fixture(params=["small", "original"])
def tree(request: pytest.FixtureRequest) -> Path:
    return request.getfixturevalue(request.param)


@pytest.fixture
def carrot(small: Path) -> Iterator[SimplerEnv]:
    from support.simpler_batches import CARROT, batch

    env = batch(small, CARROT, range(2))
    yield env
    env.close()
