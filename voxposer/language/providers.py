"""litellm and tenacity, imported late and kept quiet, and what their objects say about price and waiting.

In: responses and errors of litellm. Out: the numbers that ``voxposer.language.llm`` needs. litellm is kept from the
network, ``.env`` files and the terminal while it is imported.
"""

from __future__ import annotations

import contextlib
import datetime
import difflib
import email.utils
import functools
import importlib
import logging
import os
import re
from collections.abc import Iterator
from typing import Any

from vecenv.errors import MissingDependency

# Names of litellm's exceptions that another attempt may not meet again, whatever their status.
_PASSING = ("RateLimitError", "Timeout", "APIConnectionError", "InternalServerError", "BadGatewayError")
# HTTP statuses likewise, besides all from 500 on; and those that every request of the run will meet: no or a wrong
# key, no credit, no rights, no such model or address.
_PASSING_STATUS, _PERMANENT_STATUS = frozenset({408, 425, 429}), frozenset({401, 402, 403, 404})
# What providers call a 429 that no waiting ends.
_NO_CREDIT = re.compile(r"insufficient_quota|current quota|billing|credit balance|insufficient (credit|balance|fund)")
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


def is_permanent(error: BaseException) -> bool:
    """Whether every other request would meet this error of litellm too: the key, the account, or the model is wrong."""
    if "LLM Provider NOT provided" in str(error):
        return True
    status = getattr(error, "status_code", None)
    if status == 429:
        return bool(_NO_CREDIT.search(f"{getattr(error, 'body', '')} {error}".lower()))
    return status in _PERMANENT_STATUS


def may_pass(error: BaseException) -> bool:
    """Whether another attempt may not meet this error of litellm again."""
    if is_permanent(error):
        return False
    status = getattr(error, "status_code", None) or 0
    kinds = tuple(getattr(litellm(), name) for name in _PASSING)
    return isinstance(error, kinds) or status in _PASSING_STATUS or status >= 500


def lacks_key(model: str) -> bool:
    """Whether the variable with the key of the model's provider is not set."""
    return bool(litellm().validate_environment(model)["missing_keys"])


def reason(error: Exception, model: str) -> str:
    """What went wrong, in one line that begins with the kind of the error."""
    if "LLM Provider NOT provided" in str(error):
        close = difflib.get_close_matches(model, litellm().model_list, n=1)
        hint = f"; did you mean {close[0]}?" if close else "; write PROVIDER/MODEL, such as openai/gpt-4o"
        return f"{type(error).__name__}: litellm knows no provider of this model{hint}"
    return f"{type(error).__name__}: {first_line(error)}"


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
