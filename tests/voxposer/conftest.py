"""Fixtures of the planner's tests."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import pytest


@pytest.fixture
def explicit_ranks() -> Iterator[None]:
    """Arrays of different rank are not broadcast against one another without saying so."""
    with jax.numpy_rank_promotion("raise"):
        yield
