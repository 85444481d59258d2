"""What holds for all tests of the controllers."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module", autouse=True)
def _no_rank_promotion(no_rank_promotion: None) -> None:
    """Controllers name the axes they broadcast along."""
