"""What a language program is: its name, its options, the functions it may call, its errors and its trace.

Plain tables and records; ``voxposer.language.lmp`` runs the programs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from voxposer.language.replies import Message, Reply
from voxposer.sandbox.guard import HostFault

MAPS = ("get_affordance_map", "get_avoidance_map", "get_rotation_map", "get_velocity_map", "get_gripper_map")
NAMES = ("planner", "composer", "parse_query_obj", *MAPS)


class LmpError(HostFault):
    """A language program that could not be run, or not on.

    Attributes:
        lmp: which one.
        query: what it was asked.
        rule: the rule of the sandbox that was broken; ``reply`` if the model gave no program, ``query`` for a query
            that cannot be asked, ``result`` for a value of the wrong kind.
        reason: what happened.
        line: line of the program, None if there is none.
    """

    def __init__(self, lmp: str, query: str, rule: str, reason: str, line: int | None = None) -> None:
        where = "" if line is None else f"line {line}: "
        super().__init__(f"{lmp}({query!r}): {where}{reason} [rule: {rule}]")
        self.lmp, self.query, self.rule, self.reason, self.line = lmp, query, rule, reason, line


@dataclass(frozen=True, kw_only=True)
class LmpConfig:
    """One language program; upstream's keys.

    Attributes:
        name: the function programs call it by.
        stop: tokens that its answer ends at, where a line starts with one.
        max_tokens: length of its answer at most.
        temperature: of the model.
        query_prefix: put before a query.
        query_suffix: put after it.
        maintain_session: whether earlier queries and answers are shown again, and their variables kept.
        include_context: whether the model sees, and the program has, the list ``objects``.
        has_return: whether the program returns a value.
        return_val_name: the variable that is returned.
    """

    name: str
    stop: tuple[str, ...] = ("# Query: ", "objects =")
    max_tokens: int = 512
    temperature: float = 0.0
    query_prefix: str = "# Query: "
    query_suffix: str = "."
    maintain_session: bool = False
    include_context: bool = False
    has_return: bool = True
    return_val_name: str = "ret_val"

    def __post_init__(self) -> None:
        if self.max_tokens < 1 or not self.temperature >= 0:
            raise ValueError(f"{self.name}: max_tokens must be at least 1 and temperature not below 0")


CONFIGS: Mapping[str, LmpConfig] = MappingProxyType(
    {
        "planner": LmpConfig(name="planner", stop=("# Query: ", "objects = "), include_context=True, has_return=False),
        "composer": LmpConfig(name="composer", has_return=False),
        "parse_query_obj": LmpConfig(name="parse_query_obj", include_context=True),
        **{name: LmpConfig(name=name) for name in MAPS},
    }
)

# Functions that act, and the only LMPs whose programs may call them: maps and references are evaluated whenever
# someone looks, so nothing may happen when they are.
ACTIONS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "planner": ("composer",),
        "composer": ("execute", "reset_to_default_pose", "parse_query_obj", *MAPS),
        "parse_query_obj": (),
        **dict.fromkeys(MAPS, ("parse_query_obj",)),
    }
)
RESTRICTED = frozenset(name for names in ACTIONS.values() for name in names)


@dataclass(kw_only=True)
class Call:
    """One question to the model, and what came of it: for people to read, and to be asked again without the model.

    Attributes:
        lmp: which language program.
        query: what it was asked.
        context: the context line, empty without.
        model: the model asked.
        repair: 0 for the question itself, 1 for the first question that shows the model what its program did wrong.
        messages: the conversation that was sent.
        stop: the tokens that the answer was to end at.
        settings: what else the question was asked with (``voxposer.language.llm.LlmConfig.settings``).
        reply: the answer as it came, None if there was none.
        finish_reason: why the answer ended, as the provider names it.
        code: the answer without fences; empty if there was none.
        cached: whether the answer was kept from earlier.
        prompt_tokens: tokens of the question, as counted when it was asked; None if unknown.
        completion_tokens: tokens of the answer, likewise.
        cost_usd: its price, None if unknown.
        error: what went wrong with the answer or its program, None if nothing did.
    """

    lmp: str
    query: str
    context: str
    model: str
    repair: int = 0
    messages: Sequence[Message] = ()
    stop: Sequence[str] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    reply: str | None = None
    finish_reason: str = ""
    code: str = ""
    cached: bool = False
    prompt_tokens: int | None = None
    completion_tokens: int | None = None
    cost_usd: float | None = None
    error: str | None = None

    def note(self, reply: Reply) -> None:
        """Record what was answered."""
        self.reply, self.finish_reason, self.cached = reply.text, reply.finish_reason, reply.cached
        self.prompt_tokens, self.completion_tokens = reply.prompt_tokens, reply.completion_tokens
        self.cost_usd = reply.cost_usd
