"""Engines: where the episodes of an evaluation run.

An :class:`~vecenv_eval.runner.Evaluation` and its open results folder come in; the engine runs the episodes that have
no verdict, has every record written as its episode ends, and returns an :class:`Outcome`. ``local`` runs them in this
process, ``ray`` on actors of a Ray cluster, ``submitit`` as jobs of a scheduler. A name and its arguments
(``EvalConfig.engine`` and ``engine_args``) become an engine with :func:`make_engine`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol

from vecenv.errors import ServiceError
from vecenv.util.names import unknown
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.results import Progress

if TYPE_CHECKING:
    from vecenv_eval.runner import Evaluation
    from vecenv_eval.store import ResultStore

# Name -> the class, and the extra that installs what it needs.
ENGINES = {
    "local": ("vecenv_eval.engines.local:LocalEngine", ""),
    "ray": ("vecenv_eval.engines.ray_engine:RayEngine", "ray"),
    "submitit": ("vecenv_eval.engines.submitit_engine:SubmititEngine", "slurm"),
}


class EngineError(ServiceError):
    """What an engine runs on cannot be used: a cluster that cannot be reached, workers that cannot start."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a run of an engine ended.

    Attributes:
        interrupted: it was stopped from the keyboard.
        causes: what failed, one line each, without repetition.
    """

    interrupted: bool
    causes: tuple[str, ...]


class Engine(Protocol):
    """Runs episodes somewhere. Its constructor takes the config, and refuses arguments with a ``ConfigError``.

    Attributes:
        in_process: the policy is made in this process. Otherwise the engine writes its name to the results folder.
    """

    in_process: ClassVar[bool]

    def __init__(self, config: EvalConfig) -> None: ...

    def run(
        self, evaluation: Evaluation, store: ResultStore, index: int, on_progress: Callable[[Progress], None]
    ) -> Outcome:
        """Run the planned episodes that have no verdict in the store; Ctrl-C ends the run, without an exception.

        Args:
            evaluation: what is evaluated.
            store: the results folder.
            index: number of this run on the folder, from 0.
            on_progress: called as the run goes on.

        Raises:
            ConfigError: the environment refuses a setting.
            EngineError: nothing can run.
        """
        ...

    @classmethod
    def shared(cls) -> AbstractContextManager[None]:
        """Within it, runs one after another share what takes long to start."""
        ...


def make_engine(config: EvalConfig) -> Engine:
    """The engine that a config names.

    Raises:
        ConfigError: there is no such engine, it does not take the arguments, or its package is not installed.
    """
    return engine_class(config)(config)


def engine_class(config: EvalConfig) -> type[Engine]:
    """The class of the engine that a config names.

    Raises:
        ConfigError: there is no such engine, or its package is not installed.
    """
    if config.engine not in ENGINES:
        raise ConfigError(unknown("engine", config.engine, ENGINES))
    target, extra = ENGINES[config.engine]
    module_name, attribute = target.split(":")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if not extra or (error.name or "").startswith("vecenv"):
            raise
        raise ConfigError(f"engine {config.engine!r} needs {error.name}: pip install 'vecenv[{extra}]'") from None
    return getattr(module, attribute)
