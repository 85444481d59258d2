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
    """A request that the model did not answer; its episode has no verdict, because it is not to blame.

    Attributes:
        model: the model asked.
        reason: what happened.
        permanent: no other request can fare better (a wrong key, an unknown model, no credit left): the run is over.
        reply: what the model answered, where it answered something that cannot be used.
    """

    def __init__(self, model: str, reason: str, *, permanent: bool = False, reply: Reply | None = None) -> None:
        super().__init__(f"{model}: {reason}")
        self.model, self.reason, self.permanent, self.reply = model, reason, permanent, reply

    def again(self) -> LlmError:
        """The same error for another request that waited for the same answer."""
        return type(self)(self.model, self.reason, permanent=self.permanent, reply=self.reply)


class ReplyError(LlmError):
    """The model answered, but with nothing usable: cut off, or empty."""


class NoRuleError(ReplyError):
    """The rule base has no rule for a query. That is a property of the episode's sentence, which fails with it."""


@dataclass(frozen=True, kw_only=True)
class Reply:
    """What a model answered.

    Attributes:
        text: up to the first line that starts with a stop token, stripped; never empty.
        model: the model as the provider names it.
        finish_reason: why it ended, as the provider names it; usually ``stop``.
        prompt_tokens: tokens of the question, None if the provider does not say.
        completion_tokens: tokens of the answer, likewise.
        cost_usd: US dollars, None if litellm does not know the model's price.
        cached: whether it came from the cache, or from the same request of another slot, and cost nothing.
    """

    text: str
    model: str
    finish_reason: str
    prompt_tokens: int | None
    completion_tokens: int | None
    cost_usd: float | None
    cached: bool = False


@dataclass(frozen=True, kw_only=True)
class Usage:
    """Requests and their cost so far.

    Attributes:
        calls: answers received from the model, unusable ones included.
        cached: answers from the cache.
        retries: attempts that failed and were repeated.
        prompt_tokens: tokens of all questions as far as they are known, cached ones not counted.
        completion_tokens: tokens of all answers, likewise.
        cost_usd: US dollars of the calls whose price is known.
        uncounted: calls whose tokens are not known.
        unpriced: calls whose price is not.
    """

    calls: int = 0
    cached: int = 0
    retries: int = 0
    prompt_tokens: int = 0
    completion_tokens: int = 0
    cost_usd: float = 0.0
    uncounted: int = 0
    unpriced: int = 0

    @classmethod
    def of(cls, reply: Reply) -> Usage:
        """The usage of one answer."""
        tokens = reply.prompt_tokens, reply.completion_tokens
        return cls(
            calls=1,
            prompt_tokens=tokens[0] or 0,
            completion_tokens=tokens[1] or 0,
            cost_usd=reply.cost_usd or 0.0,
            uncounted=int(None in tokens),
            unpriced=int(reply.cost_usd is None),
        )

    def __add__(self, other: Usage) -> Usage:
        return Usage(**{name: value + getattr(other, name) for name, value in asdict(self).items()})
