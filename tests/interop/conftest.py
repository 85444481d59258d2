"""LIBERO's node set, which the tests of the tools and those of their panels share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from support.node_calls import Caller

    from vecenv.interop.nodes import EnvLiberoNodeSet


@pytest.fixture(scope="module")
def libero() -> Iterator[EnvLiberoNodeSet]:
    from support.node_calls import BUDGET, SUITE

    from vecenv.interop.nodes import EnvLiberoNodeSet

    nodes = EnvLiberoNodeSet((SUITE, "libero_goal"))
    nodes.initialize(max_steps=BUDGET)
    yield nodes
    nodes.shutdown()


@pytest.fixture
def call(libero: EnvLiberoNodeSet) -> Caller:
    """The tools, with the first episode at its start."""
    from support.node_calls import SUITE, Caller

    assert libero.panel.set_field("suite", SUITE).error == ""
    return Caller(libero)
