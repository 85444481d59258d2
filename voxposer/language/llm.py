"""Requests to a language model through litellm: retried, counted and cached.

In: chat messages, and which model of which provider (any string litellm knows; ``offline/libero``, the default, is
``voxposer.offline`` and needs neither key nor network). Out: the text up to the first line that starts with a stop
token, with its tokens and cost. Calls that fail for a passing reason (429, 5xx, timeouts, lost connections, replies
that are no JSON) are repeated with growing pauses, or after the pause the server asks for.

Complete replies are kept on disk (``voxposer.language.reply_cache``). The offline writer's replies are kept in memory
only: they cost nothing, and another version may write others.

Needs the extra ``voxposer``; litellm is imported at the first question.
"""

from __future__ import annotations

import hashlib
import json
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any, Protocol

from voxposer.language import providers
from voxposer.language.replies import LlmError, Message, Reply, ReplyError, Usage
from voxposer.language.reply_cache import cache_at
from voxposer.offline.provider import register

if TYPE_CHECKING:
    from tenacity import RetryCallState

OFFLINE = "offline/"
# Layout of requests and replies on disk; raised when it changes.
FORMAT = 1


class Response(Protocol):
    """The part of litellm's response that is read; each choice has a ``message`` and a ``finish_reason``."""

    choices: Sequence[Any]
    model: str | None


@dataclass(frozen=True, kw_only=True)
class LlmConfig:
    """Which model is asked, and how often and how long.

    Attributes:
        model: litellm's name of it, such as ``gpt-4o`` or ``openai/local``; ``offline/libero`` is rule-based and local.
        timeout_s: seconds for one attempt.
        attempts: how often a question is asked before giving up; the offline writer is asked once.
        backoff_s: seconds of the first pause; each is twice as long as the one before, plus up to a second at random.
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


class Llm:
    """A model with its cache and usage counts. Threads may share one."""

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
        self._disk = None if self._is_offline() else cache_at(self.config.cache)

    @property
    def usage(self) -> Usage:
        """Requests and cost of this object so far."""
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
            stop: the answer ends before the first line that starts with one of these; inside a line they mean nothing.
                With a line feed before them they also go to the provider, where it takes them.
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
        reply = self._with_retries(request)
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

    def _with_retries(self, request: Mapping[str, Any]) -> Reply:
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
        litellm, tenacity = providers.litellm(), providers.tenacity()
        transient = tuple(getattr(litellm, name) for name in providers.TRANSIENT)
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
            reason = providers.first_line(error)
            named = reason if self._is_offline() else f"{type(error).__name__}: {reason}"
            raise kind(self.config.model, named) from error

    def _lacks_key(self) -> bool:
        """Whether the provider's key is missing, which litellm reports as if the provider had failed."""
        if self.config.api_key is not None:
            return False
        return bool(providers.litellm().validate_environment(self.config.model)["missing_keys"])

    def _attempt(self, litellm: ModuleType, request: Mapping[str, Any]) -> Any:
        if self._is_offline():
            register()
        return litellm.completion(
            **{"max_retries": 0, "num_retries": 0, "drop_params": True},
            **request["options"],
            model=request["model"],
            messages=request["messages"],
            stop=[f"\n{token}" for token in request["stop"]] or None,
            max_tokens=request["max_tokens"],
            temperature=request["temperature"],
            timeout=self.config.timeout_s,
            api_base=self.config.api_base,
            api_key=self.config.api_key,
        )

    def _pause(self, state: RetryCallState, pauses: Callable[[RetryCallState], float]) -> float:
        asked = providers.retry_after(state.outcome.exception() if state.outcome else None)
        return pauses(state) if asked is None else min(asked, self.config.backoff_max_s)

    def _reply(self, response: Response, stop: Sequence[str]) -> Reply:
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
            cost_usd=0.0 if self._is_offline() else providers.price(response, self.config.model),
        )


def _until(stop: Sequence[str], text: str) -> str:
    """The text before the first line that starts with a stop token: not every provider stops there by itself."""
    found = re.search("^(?:" + "|".join(map(re.escape, stop)) + ")", text, re.MULTILINE) if stop else None
    return text[: found.start() if found else len(text)].strip()
