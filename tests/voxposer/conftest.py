"""A model's server and the programs' set-up, shared by the tests of language programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from support.llm_server import LlmServer
    from support.lmps import Setup


@pytest.fixture(scope="module")
def running() -> Iterator[LlmServer]:
    """A server that answers as a language model's provider does."""
    from support.llm_server import serving

    with serving() as server:
        yield server


@pytest.fixture
def setup(running: LlmServer) -> Callable[..., Setup]:
    """Makes the language programs of a robot from the answers that the model gives."""
    from support.lmps import Setup

    return lambda answers, **options: Setup(running, answers, **options)
