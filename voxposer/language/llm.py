"""Requests to a language model through litellm: retried, counted and cached.

In: chat messages, and which model of which provider (any string litellm knows; ``offline/libero``, the default, is the
rule base in ``voxposer.offline``, no language model, and needs neither key nor network). Out: the text up to the first
line that starts with a stop token, with its tokens and cost. Calls that fail for a passing reason (429, 5xx, timeouts,
lost connections, replies that are no JSON) are repeated with growing pauses, or after the pause the server asks for.
What no waiting ends (a wrong key, an unknown model, no credit) is an error at once, marked as permanent.

Complete replies are kept on disk (``voxposer.language.reply_cache``). The offline writer's replies are kept in memory
only: they cost nothing, and another version may write others. Threads that ask the same at the same time share one
request.

Needs the extra ``voxposer``; litellm is imported at the first question. The rule base answers without it.
"""

from __future__ import annotations

import hashlib
import json
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any, Protocol, Self

from voxposer.language import providers
from voxposer.language.replies import LlmError, Message, NoRuleError, Reply, ReplyError, Usage
from voxposer.language.reply_cache import cache_at
from voxposer.offline.names import NotUnderstood
from voxposer.offline.provider import MODEL as OFFLINE_MODEL
from voxposer.offline.provider import cut, write

if TYPE_CHECKING:
    from tenacity import RetryCallState

OFFLINE = "offline/"
# Layout of requests and replies on disk; raised when it changes.
FORMAT = 1
# Arguments of ``litellm.completion`` that have a setting of their own, or that this module decides.
_RESERVED = frozenset(
    {"model", "messages", "stop", "max_tokens", "temperature", "timeout", "api_base", "api_key", "stream", "n"}
    | {"max_retries", "num_retries", "drop_params"}
)


class Response(Protocol):
    """The part of litellm's response that is read; each choice has a ``message`` and a ``finish_reason``."""

    choices: Sequence[Any]
    model: str | None


@dataclass(frozen=True, kw_only=True)
class LlmConfig:
    """Which model is asked, how, how often and how long.

    Attributes:
        model: litellm's name of it, such as ``gpt-4o`` or ``openai/local``; ``offline/libero`` is rule-based and local.
        seed: of its answers, for providers that take one.
        timeout_s: seconds for one attempt.
        attempts: how often a question is asked before giving up; the offline writer is asked once.
        backoff_s: seconds of the first pause; each is twice as long as the one before, plus up to a second at random.
        backoff_max_s: seconds of the longest pause, also of one that the server asks for.
        concurrency: most questions that wait for an answer at once.
        api_base: address of the provider; litellm's own by default.
        api_key: litellm reads the provider's variable (``OPENAI_API_KEY``) by default. Never stored or shown.
        options: further arguments of ``litellm.completion``, such as ``top_p``.
        cache: whether replies are kept, or the folder to keep them in.
    """

    model: str = OFFLINE_MODEL
    seed: int | None = None
    timeout_s: float = 60.0
    attempts: int = 6
    backoff_s: float = 1.0
    backoff_max_s: float = 60.0
    concurrency: int = 8
    api_base: str | None = None
    api_key: str | None = field(default=None, repr=False)
    options: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    cache: bool | Path = True

    def __post_init__(self) -> None:
        if not self.model:
            raise ValueError(f"model is empty; name one, such as gpt-4o or {OFFLINE_MODEL}")
        if self.is_rule_base and self.model != OFFLINE_MODEL:
            raise ValueError(f"there is no model {self.model!r}; the rule base is {OFFLINE_MODEL}")
        if self.attempts < 1 or self.timeout_s <= 0 or self.backoff_s < 0 or self.backoff_max_s < 0:
            raise ValueError("attempts must be at least 1, timeout_s above 0, backoff_s and backoff_max_s not below 0")
        if self.concurrency < 1:
            raise ValueError(f"concurrency must be at least 1, not {self.concurrency}")
        if reserved := sorted(_RESERVED.intersection(self.options)):
            raise ValueError(f"options cannot hold {', '.join(reserved)}: a setting of its own decides it")

    @property
    def is_rule_base(self) -> bool:
        """Whether programs are written by rules, so that there are neither tokens nor a price."""
        return self.model.startswith(OFFLINE)

    def settings(self, max_tokens: int, temperature: float) -> dict[str, Any]:
        """What a question is asked with besides its messages and stop tokens, ready for JSON; without the key."""
        seed = {} if self.seed is None else {"seed": self.seed}
        return {
            "model": self.model,
            "api_base": self.api_base,
            "max_tokens": max_tokens,
            "temperature": temperature,
            "options": {**self.options, **seed},
        }


class Llm:
    """A model with its cache and usage counts. Threads may share one."""

    def __init__(self, config: LlmConfig | None = None, *, sleep: Callable[[float], object] | None = None) -> None:
        """A model as configured, the offline writer by default; nothing is imported or opened before a question.

        Args:
            config: which model, and how.
            sleep: waits a number of seconds between attempts; by default until then or until :meth:`close`.
        """
        self.config = config or LlmConfig()
        self._closed = threading.Event()
        self._sleep = sleep or self._closed.wait
        self._usage, self._lock = Usage(), threading.Lock()
        self._memory: dict[str, Reply] = {}
        self._pending: dict[str, Future[Reply]] = {}
        self._disk = None if self.config.is_rule_base else cache_at(self.config.cache)

    @property
    def usage(self) -> Usage:
        """Requests and cost of this object so far."""
        with self._lock:
            return self._usage

    def for_episode(self, episode: str) -> Self:
        """What answers the questions of one episode, by its name: this object, unless replies depend on it."""
        del episode
        return self

    def close(self) -> None:
        """Ask nothing again; questions under way end with their present attempt."""
        self._closed.set()

    def complete(
        self,
        messages: Sequence[Message],
        *,
        stop: Sequence[str] = (),
        max_tokens: int = 512,
        temperature: float = 0.0,
        note: Callable[[Reply], object] | None = None,
        check: Callable[[str], object] | None = None,
    ) -> Reply:
        """The model's answer to a conversation.

        Args:
            messages: ``role`` and ``content`` each.
            stop: the answer ends before the first line that starts with one of these; inside a line they mean nothing.
                With a line feed before them they also go to the provider, where it takes them.
            max_tokens: length of the answer at most.
            temperature: 0 for the likeliest answer.
            note: called with the answer before it is checked.
            check: called with the text of a new answer; if it raises, so does this, and the answer is not kept.

        Raises:
            NoRuleError: the offline writer does not understand the query.
            ReplyError: the answer is cut off at ``max_tokens`` or empty.
            LlmError: no answer came, however often asked, or the provider refuses (a wrong key, an unknown model).
        """
        request = self._request(messages, stop, max_tokens, temperature)
        look = _Look(note or _ignored, check or _ignored)
        if not self.config.cache:
            return look(self._with_retries(request))
        key = hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()
        with self._lock:
            kept, other = self._memory.get(key), self._pending.get(key)
            if kept is None and other is None:
                mine = self._pending[key] = Future()
        if kept is not None:
            self._count(Usage(cached=1))
            return kept
        if other is not None:
            return look(self._of_other(other))
        return self._first(key, request, mine, look)

    def _request(
        self, messages: Sequence[Message], stop: Sequence[str], max_tokens: int, temperature: float
    ) -> dict[str, Any]:
        """Everything that decides the answer, ready for JSON."""
        said = {"messages": [dict(message) for message in messages], "stop": list(stop)}
        return {"format": FORMAT, **said, **self.config.settings(max_tokens, temperature)}

    # What is kept

    def _first(self, key: str, request: Mapping[str, Any], mine: Future[Reply], look: _Look) -> Reply:
        """The answer from the disk or the model; who asks the same meanwhile gets it too, and whoever asks later."""
        try:
            kept = None if self._disk is None else self._disk.get(key)
            reply = self._with_retries(request) if kept is None else replace(kept, cached=True)
            mine.set_result(reply)
            if kept is not None:
                self._count(Usage(cached=1))
            else:
                look(reply)
            self._keep(key, request, reply)
            return reply
        except BaseException as error:
            if not mine.done():
                mine.set_exception(error)
            raise
        finally:
            with self._lock:
                del self._pending[key]

    def _of_other(self, other: Future[Reply]) -> Reply:
        """What came of the same request, which another thread has made."""
        try:
            reply = replace(other.result(), cached=True)
        except LlmError as error:
            raise error.again() from error
        self._count(Usage(cached=1))
        return reply

    def _keep(self, key: str, request: Mapping[str, Any], reply: Reply) -> None:
        with self._lock:
            self._memory[key] = replace(reply, cached=True)
        if self._disk is not None and not reply.cached:
            self._disk.put(key, request, reply)

    def _count(self, used: Usage) -> None:
        with self._lock:
            self._usage += used

    # The question

    def _with_retries(self, request: Mapping[str, Any]) -> Reply:
        model = self.config.model
        reply = (
            self._by_rule(request)
            if self.config.is_rule_base
            else self._reply(self._answered(request), request["stop"])
        )
        self._count(Usage(calls=1) if self.config.is_rule_base else Usage.of(reply))
        if reply.finish_reason == "length":
            limit = request["max_tokens"]
            raise ReplyError(model, f"the answer is cut off at {limit} tokens; raise max_tokens", reply=reply)
        if not reply.text:
            raise ReplyError(model, f"the answer is empty (it ended with {reply.finish_reason!r})", reply=reply)
        return reply

    def _by_rule(self, request: Mapping[str, Any]) -> Reply:
        """The rule base's answer, which needs no litellm."""
        try:
            program = write(request["messages"])
        except NotUnderstood as error:
            raise NoRuleError(OFFLINE_MODEL, f"{OFFLINE_MODEL} does not understand: {error}") from error
        text, ended = cut(program, [f"\n{token}" for token in request["stop"]], request["max_tokens"])
        if ended == "length":
            told = f"its program has more than {request['max_tokens']} tokens; say it in several instructions"
            raise NoRuleError(OFFLINE_MODEL, f"{OFFLINE_MODEL}: {told}, or raise max_tokens")
        return Reply(
            text=_until(request["stop"], text),
            model=OFFLINE_MODEL,
            finish_reason=ended,
            prompt_tokens=None,
            completion_tokens=None,
            cost_usd=None,
        )

    def _answered(self, request: Mapping[str, Any]) -> Any:
        """The provider's response, after as many attempts as it takes and is allowed."""
        litellm, tenacity = providers.litellm(), providers.tenacity()
        doubling = tenacity.wait_exponential(multiplier=self.config.backoff_s, max=self.config.backoff_max_s)
        pauses = doubling + tenacity.wait_random(0, min(self.config.backoff_s, 1.0))
        retrying = tenacity.Retrying(
            retry=tenacity.retry_if_exception(self._may_pass),
            stop=tenacity.stop_after_attempt(self.config.attempts) | tenacity.stop_when_event_set(self._closed),
            wait=lambda state: self._pause(state, pauses),
            before_sleep=lambda state: self._count(Usage(retries=1)),
            sleep=self._sleep,
            reraise=True,
        )
        try:
            return retrying(self._attempt, litellm, request)
        except Exception as error:  # litellm passes on whatever a provider's code raises
            raise self._error(error, retrying.statistics.get("attempt_number", 1)) from error

    def _error(self, error: Exception, attempts: int) -> LlmError:
        """What a request ended with, as one of ours."""
        model = self.config.model
        if self._lacks_key():
            return LlmError(model, providers.reason(error, model), permanent=True)
        tries = f" ({attempts} attempts)" if attempts > 1 else ""
        return LlmError(model, providers.reason(error, model) + tries, permanent=providers.is_permanent(error))

    def _may_pass(self, error: BaseException) -> bool:
        return providers.may_pass(error) and not self._lacks_key()

    def _lacks_key(self) -> bool:
        """Whether the provider's key is missing, which litellm reports as if the provider had failed."""
        return self.config.api_key is None and providers.lacks_key(self.config.model)

    def _attempt(self, litellm: ModuleType, request: Mapping[str, Any]) -> Any:
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
        sent, made = _tokens(response)
        unknown = sent is None
        return Reply(
            text=_until(stop, _characters(choices[0].message.content or "")),
            model=response.model or self.config.model,
            finish_reason=choices[0].finish_reason or "stop",
            prompt_tokens=None if unknown else sent,
            completion_tokens=None if unknown else made,
            cost_usd=None if unknown else providers.price(response, self.config.model),
        )


@dataclass(frozen=True)
class _Look:
    """What a caller does with a new answer: notes it, then checks its text."""

    note: Callable[[Reply], object]
    check: Callable[[str], object]

    def __call__(self, reply: Reply) -> Reply:
        self.note(reply)
        self.check(reply.text)
        return reply


def _ignored(value: object) -> None:
    """Does nothing."""


def _tokens(response: Response) -> tuple[int | None, int | None]:
    """Tokens of question and answer; litellm puts 0 where the provider does not say, and no question has none."""
    usage = getattr(response, "usage", None)
    sent, made = getattr(usage, "prompt_tokens", None), getattr(usage, "completion_tokens", None)
    return (sent, made) if sent else (None, None)


def _characters(text: str) -> str:
    """Text that can be written to files: JSON may hold halves of characters, which are put together or replaced."""
    return text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")


def _until(stop: Sequence[str], text: str) -> str:
    """The text before the first line that starts with a stop token: not every provider stops there by itself."""
    found = re.search("^(?:" + "|".join(map(re.escape, stop)) + ")", text, re.MULTILINE) if stop else None
    return text[: found.start() if found else len(text)].strip()
