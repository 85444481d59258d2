"""SIMPLER as a family of suites, for ``vecenv.registry``. Imports neither SAPIEN nor anything heavy before ``make``."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

from vecenv import protocols
from vecenv.registry import ExtraMissing
from vecenv.simpler.tasks import SUITES, list_tasks

if TYPE_CHECKING:
    from vecenv.simpler.config import SimplerConfig
    from vecenv.simpler.env import SimplerEnv

__all__ = ["config_type", "eval_metadata", "list_suites", "list_tasks", "make"]

# Packages that SIMPLER imports and the core does not need.
_EXTRA = ("sapien", "ruckig", "trimesh", "PIL")


def list_suites() -> tuple[str, ...]:
    """SIMPLER's two suites."""
    return SUITES


def config_type() -> type[SimplerConfig]:
    """The options of a SIMPLER batch."""
    from vecenv.simpler.config import SimplerConfig

    return SimplerConfig


def make(suite: str, tasks: object, episodes: object, config: SimplerConfig) -> SimplerEnv:
    """A batch of SIMPLER episodes; ``vecenv.make`` documents the arguments.

    Raises:
        ExtraMissing: packages that are not installed.
    """
    missing = [name for name in _EXTRA if importlib.util.find_spec(name) is None]
    if missing:
        needed = f"{suite} needs {', '.join(missing)}: pip install 'vecenv[simpler]'"
        raise ExtraMissing(f"{needed} (SAPIEN's wheels are for Python 3.11 and 3.12)", name=missing[0])
    from vecenv.simpler.env import make

    return make(suite, tasks=tasks, episodes=episodes, config=config)


def eval_metadata(suite: str, protocol: str) -> dict[str, object]:
    """What ``vecenv.eval_metadata`` returns of a SIMPLER suite: episodes as the protocol has them of each task."""
    from vecenv.simpler.published import metadata

    chosen = protocols.protocol(protocol, protocols.SIMPLER)
    return {**metadata.eval_metadata(suite, chosen.name), "protocol": chosen.to_dict()}
