"""A chat model that programs a robot to lift its hand, and agents that ask it over HTTP."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from support.llm_server import Answer, LlmServer, code
from support.lmps import asked, asked_of
from support.voxposer_world import Obedient, box, snapshot
from vecenv.contract import BatchEnv
from voxposer.agent import Agent, AgentConfig
from voxposer.language.llm import Llm, LlmConfig

CUBE = {"cube_1": box((0.02, 0.02, 0.02), (0.2, 0.1, 0.02))}
PROGRAMS = {
    "planner": 'composer("lift up")',
    "composer": "execute(parse_query_obj('gripper'), affordance_map=get_affordance_map('above'))",
    "parse_query_obj": "ret_val = detect('gripper')",
    "get_affordance_map": (
        "volume = get_empty_affordance_map()\n"
        "x, y, z = parse_query_obj('gripper').position\n"
        "volume[x, y, z + 5] = 1\n"
        "ret_val = volume"
    ),
}


class Writer:
    """Answers by what is asked of it: a reply for a query, else the program of the LMP.

    Args:
        server: which it answers for.
        replies: query -> replies in turn, of which the last stays.
    """

    def __init__(self, server: LlmServer, replies: Mapping[str, Any] | None = None) -> None:
        self.replies = {
            query: list(each) if isinstance(each, list) else [each] for query, each in (replies or {}).items()
        }
        server.requests.clear()
        server.most_in_flight = 0
        server.answer = self

    def __call__(self, request: dict[str, Any]) -> Answer:
        turn = self.replies.get(asked(request))
        if turn is None:
            return code(PROGRAMS[asked_of(request)])
        found: Any = turn.pop(0) if len(turn) > 1 else turn[0]
        found = found(request) if callable(found) else found
        return code(found) if isinstance(found, str) else found


def model(server: LlmServer, **options: Any) -> Llm:
    """The server's model, asked once and not cached unless options say more."""
    fields = {"model": "openai/local", "api_base": server.base, "api_key": "k", "cache": False, "attempts": 1}
    return Llm(LlmConfig(**{**fields, **options}))


def agent(llm: Llm, *instructions: str, **options: Any) -> tuple[Agent, Obedient]:
    """An agent with a slot for each instruction."""
    env = Obedient(*(snapshot(CUBE) for _ in instructions))
    config = AgentConfig(**{"passes": 1, **options})
    names = tuple(f"s/0/{number}" for number in range(len(instructions)))
    return Agent(cast(BatchEnv, env), instructions, llm, config, episodes=names), env
