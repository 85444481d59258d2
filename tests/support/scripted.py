"""A language model that answers from a script, and environments in which its programs are carried out."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from voxposer.language.llm import Llm, LlmConfig
from voxposer.language.replies import Message, Reply

# LMP -> its reply to every query, or a function of the query.
Script = Mapping[str, str | Callable[[str], str]]


class ScriptedLlm(Llm):
    """Answers each query with the script's program for its language program.

    Attributes:
        asked: every (language program, query) so far, in order.
    """

    def __init__(self, script: Script) -> None:
        super().__init__(LlmConfig(model="scripted", cache=False))
        self._script = script
        self.asked: list[tuple[str, str]] = []

    def complete(self, messages: Sequence[Message], **options: Any) -> Reply:
        """The script's answer."""
        (name,) = re.findall(r"Queries are for `(\w+)`", messages[1]["content"])
        query = messages[-1]["content"].splitlines()[-1].removeprefix("# Query: ").removesuffix(".")
        self.asked.append((name, query))
        found = self._script[name]
        text = found if isinstance(found, str) else found(query)
        counts = {"prompt_tokens": 0, "completion_tokens": 0, "cost_usd": 0.0}
        return Reply(text=text, model="scripted", finish_reason="stop", **counts)
