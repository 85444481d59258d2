"""Questions to a language model through litellm: retried, counted, and never paid for twice.

In: chat messages, and which model of which provider (any string litellm knows; ``offline/libero``, the default, is
``voxposer.offline`` and needs neither key nor network). Out: the text up to the first stop token, with its tokens and
cost. Calls that fail for a passing reason (429, 5xx, timeouts, lost connections, replies that are no JSON) are repeated
with growing pauses, or after the pause the server asks for.

Complete replies are kept on disk, found by a hash of the whole request, in one SQLite file (``replies.sqlite3`` in the
folder ``llm`` of vecenv's cache; ``VECENV_CACHE_DIR`` names another place, and set to nothing turns it off). Its values
are JSON, any number of processes may share it, and deleting it is safe at any time. The offline writer's replies are
kept in memory only: they cost nothing, and another version may write others.

Needs the extra ``voxposer``; litellm is imported at the first question.
"""

from __future__ import annotations

import contextlib
import datetime
import email.utils
import functools
import hashlib
import importlib
import json
import logging
import os
import re
import sqlite3
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from vecenv.errors import ServiceError
from vecenv.util import caching
from voxposer.sandbox.guard import HostFault

OFFLINE = "offline/"
# Layout of requests and replies on disk; raised when it changes.
FORMAT = 1

Message = Mapping[str, str]

_CLASSES = re.compile(r"^(litellm\.)?(\w+Error: |Timeout: |Timeout Error: )*(\w+Exception - )?(error - )?")
# Seconds another process may hold the cache.
_BUSY_S = 30.0
_TRANSIENT = (
    "RateLimitError",
    "Timeout",
    "APIConnectionError",
    "InternalServerError",
    "BadGatewayError",
    "ServiceUnavailableError",
)


class LlmError(ServiceError, HostFault):
    """A question that the model did not answer.

    Attributes:
        model: the model asked.
        reason: what happened.
    """

    def __init__(self, model: str, reason: str) -> None:
        super().__init__(f"{model}: {reason}")
        self.model, self.reason = model, reason


class ReplyError(LlmError):
    """The model did answer, but with nothing to use: cut off, empty, or that it does not understand."""


@dataclass(frozen=True, kw_only=True)
class LlmConfig:
    """Which model is asked, and how patiently.

    Attributes:
        model: litellm's name of it, such as ``gpt-4o`` or ``openai/local``; ``offline/libero`` is rule-based and local.
        timeout_s: seconds for one attempt.
        attempts: how often a question is asked before giving up; the offline writer is asked once.
        backoff_s: seconds of the first pause; each is twice as long as the one before, up to a second of chance added.
        backoff_max_s: seconds of the longest pause, also of one that the server asks for.
        api_base: address of the provider; litellm's own by default.
        api_key: litellm reads the provider's variable (``OPENAI_API_KEY``) by default. Never stored or shown.
        options: further arguments of ``litellm.completion``, such as ``seed``.
        cache: whether replies are kept, or the folder to keep them in.
    """

    model: str = "offline/libero"
    timeout_s: float = 60.0
    attempts: int = 6
    backoff_s: float = 1.0
    backoff_max_s: float = 60.0
    api_base: str | None = None
    api_key: str | None = field(default=None, repr=False)
    options: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    cache: bool | Path = True

    def __post_init__(self) -> None:
        if not self.model:
            raise ValueError("model is empty; name one, such as gpt-4o or offline/libero")
        if self.attempts < 1 or self.timeout_s <= 0 or self.backoff_s < 0 or self.backoff_max_s < 0:
            raise ValueError(f"attempts must be at least 1, timeout_s above 0 and backoffs not below 0: {self}")


@dataclass(frozen=True, kw_only=True)
class Reply:
    """What a model answered.

    Attributes:
        text: up to the first stop token, stripped; never empty.
        model: the model as the provider names it.
        finish_reason: why it ended, the provider's word; ``stop`` as a rule.
        prompt_tokens: tokens of the question.
        completion_tokens: tokens of the answer.
        cost_usd: US dollars, None if litellm does not know the model's price.
        cached: whether it was kept from earlier, and so cost nothing now.
    """

    text: str
    model: str
    finish_reason: str
    prompt_tokens: int
    completion_tokens: int
    cost_usd: float | None
    cached: bool = False


@dataclass(frozen=True, kw_only=True)
class Usage:
    """What has been asked and paid so far.

    Attributes:
        calls: answers received from the model, unusable ones included.
        cached: answers from the cache.
        retries: attempts that failed and were repeated.
        prompt_tokens: tokens of all questions, cached ones not counted.
        completion_tokens: tokens of all answers, likewise.
        cost_usd: US dollars of the calls whose price is known.
        unpriced: calls whose price is not.
    """

    calls: int = 0
    cached: int = 0
    retries: int = 0
    prompt_tokens: int = 0
    completion_tokens: int = 0
    cost_usd: float = 0.0
    unpriced: int = 0

    def __add__(self, other: Usage) -> Usage:
        return Usage(**{name: value + getattr(other, name) for name, value in asdict(self).items()})


class Llm:
    """A model to ask, with its cache and its bill. Threads may share one."""

    def __init__(self, config: LlmConfig | None = None, *, sleep: Callable[[float], None] = time.sleep) -> None:
        """A model as configured, the offline writer by default; nothing is imported or opened before a question.

        Args:
            config: which model, and how.
            sleep: waits a number of seconds between attempts.
        """
        self.config = config or LlmConfig()
        self._sleep = sleep
        self._usage, self._lock = Usage(), threading.Lock()
        self._memory: dict[str, Reply] = {}
        self._disk = None if self._is_offline() else _cache(self.config.cache)

    @property
    def usage(self) -> Usage:
        """What has been asked and paid through this object."""
        with self._lock:
            return self._usage

    def complete(
        self,
        messages: Sequence[Message],
        *,
        stop: Sequence[str] = (),
        max_tokens: int = 512,
        temperature: float = 0.0,
        check: Callable[[str], object] | None = None,
    ) -> Reply:
        """The model's answer to a conversation.

        Args:
            messages: ``role`` and ``content`` each.
            stop: the answer ends before the first of these; they also go to the provider where it takes them.
            max_tokens: length of the answer at most.
            temperature: 0 for the likeliest answer.
            check: called with the text of a new answer; if it raises, so does this, and the answer is not kept.

        Raises:
            ReplyError: the answer is cut off at ``max_tokens`` or empty, or the offline writer does not understand.
            LlmError: no answer came, however often asked, or the provider refuses (a wrong key, an unknown model).
        """
        request = self._request(messages, stop, max_tokens, temperature)
        key = hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()
        kept = self._kept(key)
        if kept is not None:
            self._count(Usage(cached=1))
            return kept
        reply = self._asked(request)
        if check is not None:
            check(reply.text)
        self._keep(key, request, reply)
        return reply

    def _is_offline(self) -> bool:
        return self.config.model.startswith(OFFLINE)

    def _request(
        self, messages: Sequence[Message], stop: Sequence[str], max_tokens: int, temperature: float
    ) -> dict[str, Any]:
        """Everything that decides the answer, ready for JSON."""
        return {
            "format": FORMAT,
            "model": self.config.model,
            "api_base": self.config.api_base,
            "messages": [dict(message) for message in messages],
            "stop": list(stop),
            "max_tokens": max_tokens,
            "temperature": temperature,
            "options": dict(self.config.options),
        }

    # What is kept

    def _kept(self, key: str) -> Reply | None:
        if not self.config.cache:
            return None
        with self._lock:
            reply = self._memory.get(key)
        if reply is None and self._disk is not None:
            reply = self._disk.get(key)
        if reply is None:
            return None
        with self._lock:
            return self._memory.setdefault(key, replace(reply, cached=True))

    def _keep(self, key: str, request: Mapping[str, Any], reply: Reply) -> None:
        if not self.config.cache:
            return
        with self._lock:
            self._memory[key] = replace(reply, cached=True)
        if self._disk is not None:
            self._disk.put(key, request, reply)

    def _count(self, used: Usage) -> None:
        with self._lock:
            self._usage += used

    # The question

    def _asked(self, request: Mapping[str, Any]) -> Reply:
        response = self._answered(request)
        reply = self._reply(response, request["stop"])
        self._count(
            Usage(
                calls=1,
                prompt_tokens=reply.prompt_tokens,
                completion_tokens=reply.completion_tokens,
                cost_usd=reply.cost_usd or 0.0,
                unpriced=int(reply.cost_usd is None),
            )
        )
        if reply.finish_reason == "length":
            limit = request["max_tokens"]
            raise ReplyError(self.config.model, f"the answer is cut off at {limit} tokens; raise max_tokens")
        if not reply.text:
            raise ReplyError(self.config.model, f"the answer is empty (it ended with {reply.finish_reason!r})")
        return reply

    def _answered(self, request: Mapping[str, Any]) -> Any:
        """The provider's response, after as many attempts as it takes and is allowed."""
        litellm, tenacity = _litellm(), _tenacity()
        transient = tuple(getattr(litellm, name) for name in _TRANSIENT)
        doubling = tenacity.wait_exponential(multiplier=self.config.backoff_s, max=self.config.backoff_max_s)
        pauses = doubling + tenacity.wait_random(0, min(self.config.backoff_s, 1.0))
        retrying = tenacity.Retrying(
            retry=tenacity.retry_if_exception(lambda error: isinstance(error, transient) and not self._lacks_key()),
            stop=tenacity.stop_after_attempt(1 if self._is_offline() else self.config.attempts),
            wait=lambda state: self._pause(state, pauses),
            before_sleep=lambda state: self._count(Usage(retries=1)),
            sleep=self._sleep,
            reraise=True,
        )
        try:
            return retrying(self._attempt, litellm, request)
        except Exception as error:  # litellm passes on whatever a provider's code raises
            kind = ReplyError if self._is_offline() else LlmError
            reason = _told(error) if self._is_offline() else f"{type(error).__name__}: {_told(error)}"
            raise kind(self.config.model, reason) from error

    def _lacks_key(self) -> bool:
        """Whether the provider's key is missing, which litellm reports as if the provider had failed."""
        return self.config.api_key is None and bool(_litellm().validate_environment(self.config.model)["missing_keys"])

    def _attempt(self, litellm: Any, request: Mapping[str, Any]) -> Any:
        if self._is_offline():
            _register_offline()
        return litellm.completion(
            **{"max_retries": 0, "num_retries": 0, "drop_params": True},
            **request["options"],
            model=request["model"],
            messages=request["messages"],
            stop=request["stop"] or None,
            max_tokens=request["max_tokens"],
            temperature=request["temperature"],
            timeout=self.config.timeout_s,
            api_base=self.config.api_base,
            api_key=self.config.api_key,
        )

    def _pause(self, state: Any, pauses: Callable[[Any], float]) -> float:
        asked = _retry_after(state.outcome.exception())
        return pauses(state) if asked is None else min(asked, self.config.backoff_max_s)

    def _reply(self, response: Any, stop: Sequence[str]) -> Reply:
        choices = getattr(response, "choices", None)
        if not choices:
            raise ReplyError(self.config.model, "the response has no answer in it")
        usage = getattr(response, "usage", None)
        return Reply(
            text=_until(stop, choices[0].message.content or ""),
            model=response.model or self.config.model,
            finish_reason=choices[0].finish_reason or "stop",
            prompt_tokens=getattr(usage, "prompt_tokens", None) or 0,
            completion_tokens=getattr(usage, "completion_tokens", None) or 0,
            cost_usd=0.0 if self._is_offline() else _price(response, self.config.model),
        )


def _until(stop: Sequence[str], text: str) -> str:
    """The text before the first stop token: not every provider stops there by itself."""
    found = [place for place in (text.find(token) for token in stop) if place >= 0]
    return text[: min(found, default=len(text))].strip()


def _price(response: Any, model: str) -> float | None:
    try:
        return float(_litellm().completion_cost(completion_response=response, model=model))
    except Exception:  # litellm raises its own error, or another, at models it has no price for
        return None


def _retry_after(error: BaseException | None) -> float | None:
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


def _told(error: Exception) -> str:
    """What an error says, in one line: litellm puts names of classes before it, tracebacks and offers of help after."""
    lines = str(error).splitlines()
    return _CLASSES.sub("", lines[0]) if lines else ""


# Libraries


@functools.cache
def _litellm() -> Any:
    """litellm, told to leave the network, ``.env`` files and the terminal alone.

    Raises:
        ImportError: it is not installed.
    """
    with _environment(LITELLM_LOCAL_MODEL_COST_MAP="True", LITELLM_MODE="PRODUCTION"):
        litellm = _library("litellm")
    litellm.suppress_debug_info = True
    litellm.telemetry = False
    for name in ("LiteLLM", "LiteLLM Router", "LiteLLM Proxy"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return litellm


def _tenacity() -> Any:
    return _library("tenacity")


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"language models need {name}: pip install 'vecenv[voxposer]' ({error})") from error


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


def _register_offline() -> None:
    """Make ``offline/...`` known to litellm."""
    importlib.import_module("voxposer.offline").register()


# The cache


def _cache(wanted: bool | Path) -> ReplyCache | None:
    where = wanted if isinstance(wanted, Path) else caching.folder("llm") if wanted else None
    return None if where is None else ReplyCache(where)


class ReplyCache:
    """Replies on disk by the hash of their requests; a file that cannot be used is a warning, not an error."""

    def __init__(self, where: Path) -> None:
        """A cache in a folder, which is created at the first use."""
        self.path = where / "replies.sqlite3"

    def get(self, key: str) -> Reply | None:
        """The reply to a request, None if there is none or it is damaged."""
        if not self.path.exists():
            return None
        with self._warning(), self._open() as connection:
            row = connection.execute("SELECT reply FROM replies WHERE key = ?", (key,)).fetchone()
            return None if row is None else _decoded(row[0])
        return None

    def put(self, key: str, request: Mapping[str, Any], reply: Reply) -> None:
        """Keep a reply; one that is there already stays, so that all processes agree."""
        with self._warning():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self._open() as connection:
                row = (key, json.dumps(request, sort_keys=True), json.dumps(asdict(reply)))
                connection.execute("INSERT OR IGNORE INTO replies VALUES (?, ?, ?)", row)

    @contextlib.contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        """A connection of this thread and process alone; what is done in it is stored whole or not at all."""
        with contextlib.closing(sqlite3.connect(self.path, timeout=_BUSY_S)) as connection, connection:
            connection.execute("CREATE TABLE IF NOT EXISTS replies (key TEXT PRIMARY KEY, request TEXT, reply TEXT)")
            yield connection

    @contextlib.contextmanager
    def _warning(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            message = f"{self.path}: replies of language models are not kept ({error}); if it is damaged, delete it"
            warnings.warn(message, stacklevel=4)


def _decoded(text: Any) -> Reply | None:
    try:
        reply = Reply(**json.loads(text))
    except (ValueError, TypeError):
        return None
    numbers = (reply.prompt_tokens, reply.completion_tokens, reply.cost_usd or 0.0)
    words = (reply.text, reply.model, reply.finish_reason)
    sound = all(isinstance(word, str) for word in words) and all(isinstance(number, (int, float)) for number in numbers)
    return reply if sound and reply.text else None
