"""litellm and tenacity, imported late and kept quiet, and what their objects say about price and waiting.

In: responses and errors of litellm. Out: the numbers that ``voxposer.language.llm`` needs. litellm is kept from the
network, ``.env`` files and the terminal while it is imported.
"""

from __future__ import annotations

import contextlib
import datetime
import email.utils
import functools
import importlib
import logging
import os
import re
from collections.abc import Iterator
from typing import Any

from vecenv.errors import MissingDependency

# Names of litellm's exceptions that another attempt may not meet again.
TRANSIENT = (
    "RateLimitError",
    "Timeout",
    "APIConnectionError",
    "InternalServerError",
    "BadGatewayError",
    "ServiceUnavailableError",
)
_CLASSES = re.compile(r"^(litellm\.)?(\w+Error: |Timeout: |Timeout Error: )*(\w+Exception - )?(error - )?")


@functools.cache
def litellm() -> Any:
    """litellm, configured not to use the network, ``.env`` files or the terminal.

    Raises:
        MissingDependency: it is not installed.
    """
    with _environment(LITELLM_LOCAL_MODEL_COST_MAP="True", LITELLM_MODE="PRODUCTION"):
        litellm = _library("litellm")
    litellm.suppress_debug_info = True
    litellm.telemetry = False
    for name in ("LiteLLM", "LiteLLM Router", "LiteLLM Proxy"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return litellm


def tenacity() -> Any:
    """tenacity.

    Raises:
        MissingDependency: it is not installed.
    """
    return _library("tenacity")


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingDependency(f"language models need {name}: pip install 'vecenv[voxposer]' ({error})") from error


@contextlib.contextmanager
def _environment(**values: str) -> Iterator[None]:
    """Variables set for a while, those that the user has set left as they are."""
    missing = {name: value for name, value in values.items() if name not in os.environ}
    os.environ.update(missing)
    try:
        yield
    finally:
        for name in missing:
            os.environ.pop(name, None)


def price(response: object, model: str) -> float | None:
    """Price of a response in US dollars; None if litellm does not know the model's price."""
    try:
        return float(litellm().completion_cost(completion_response=response, model=model))
    except Exception:  # litellm raises its own error, or another, at models it has no price for
        return None


def retry_after(error: BaseException | None) -> float | None:
    """Seconds that the server asks to wait, given as seconds or as a date."""
    asked = (getattr(error, "litellm_response_headers", None) or {}).get("retry-after")
    if asked is None:
        return None
    with contextlib.suppress(ValueError):
        return max(float(asked), 0.0)
    with contextlib.suppress(ValueError, TypeError):
        then = email.utils.parsedate_to_datetime(asked)
        return max((then - datetime.datetime.now(datetime.UTC)).total_seconds(), 0.0)
    return None


def first_line(error: Exception) -> str:
    """What an error says, in one line: litellm puts names of classes before it, tracebacks and offers of help after."""
    lines = str(error).splitlines()
    return _CLASSES.sub("", lines[0]) if lines else ""
