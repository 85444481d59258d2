"""Which episodes a results folder will have: what its ``config.json`` asks for.

Settings come in as a mapping that nobody has checked; a :class:`Plan` goes out, or nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from vecenv.errors import VecenvError
from vecenv_eval.config import EvalConfig
from vecenv_eval.episodes import Episode


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a config asks for.

    Attributes:
        suite: the suite.
        episodes: every episode.
        instructions: of each of its tasks.
    """

    suite: str
    episodes: frozenset[Episode]
    instructions: Mapping[int, str]

    def joined(self, other: Plan) -> Plan:
        """What both ask for."""
        return replace(
            self, episodes=self.episodes | other.episodes, instructions={**self.instructions, **other.instructions}
        )


def planned(settings: Mapping[str, Any]) -> Plan | None:
    """What settings ask for; None where they are none, or their suite is not installed here."""
    from vecenv_eval.runner import chosen_episodes
    from vecenv_eval.simulator import describe_suite

    try:
        config = EvalConfig.from_dict(settings)
        suite = describe_suite(config.suite, config.protocol)
        _, episodes = chosen_episodes(config, suite)
    except (VecenvError, ValueError, TypeError, LookupError, OSError, RecursionError):
        return None
    return Plan(
        suite=suite.name,
        episodes=frozenset(Episode(suite.name, task, number) for task in episodes for number in episodes[task]),
        instructions={task: suite.instructions[task] for task in episodes},
    )
