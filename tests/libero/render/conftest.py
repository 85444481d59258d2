"""A renderer of the scene of boxes."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from support.box_scene import SIZE, tiny_scene

from vecenv.libero.render.drawing import Stage
from vecenv.libero.render.gl import GlRenderer


@pytest.fixture(scope="module")
def stage() -> Stage:
    return Stage(tiny_scene())


@pytest.fixture
def renderer(stage: Stage) -> Iterator[GlRenderer]:
    made = GlRenderer([stage], height=SIZE, width=SIZE, num_threads=2)
    yield made
    made.close()
