"""A model's server and the programs' set-up, shared by the tests of language programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from vecenv.util import caching
from voxposer.language.llm import LlmConfig

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
def server(running: LlmServer) -> LlmServer:
    """The same, with nothing asked yet."""
    running.requests.clear()
    running.say("pass")
    return running


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of this test's own."""
    monkeypatch.setenv(caching.VARIABLE, str(tmp_path))
    return tmp_path / "llm"


@pytest.fixture
def config(server: LlmServer, folder: Path) -> LlmConfig:
    """Settings that ask it."""
    return LlmConfig(model="openai/local", api_base=server.base, api_key="secret", timeout_s=5, attempts=4, backoff_s=2)


@pytest.fixture
def setup(running: LlmServer) -> Callable[..., Setup]:
    """Makes the language programs of a robot from the answers that the model gives."""
    from support.lmps import Setup

    return lambda answers, **options: Setup(running, answers, **options)
