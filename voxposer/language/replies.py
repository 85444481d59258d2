"""What a language model answers: replies, their tokens and cost, and the errors in their place.

Plain records; they are made by ``voxposer.language.llm`` and stored by ``voxposer.language.reply_cache``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from vecenv.errors import ServiceError
from voxposer.sandbox.guard import HostFault

Message = Mapping[str, str]


class LlmError(ServiceError, HostFault):
    """A request that the model did not answer.

    Attributes:
        model: the model asked.
        reason: what happened.
    """

    def __init__(self, model: str, reason: str) -> None:
        super().__init__(f"{model}: {reason}")
        self.model, self.reason = model, reason


class ReplyError(LlmError):
    """The model answered, but with nothing usable: cut off, empty, or not understood."""


@dataclass(frozen=True, kw_only=True)
class Reply:
    """What a model answered.

    Attributes:
        text: up to the first line that starts with a stop token, stripped; never empty.
        model: the model as the provider names it.
        finish_reason: why it ended, as the provider names it; usually ``stop``.
        prompt_tokens: tokens of the question.
        completion_tokens: tokens of the answer.
        cost_usd: US dollars, None if litellm does not know the model's price.
        cached: whether it came from the cache and cost nothing.
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
    """Requests and their cost so far.

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
