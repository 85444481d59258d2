"""Episodes in this process, one stream after the other (``vecenv_eval.loop``)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import AbstractContextManager, nullcontext
from typing import ClassVar

from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.engine import Outcome
from vecenv_eval.episodes import Episode, Stream
from vecenv_eval.loop import EpisodeLoop
from vecenv_eval.results import Progress
from vecenv_eval.runner import Evaluation
from vecenv_eval.sink import FolderSink
from vecenv_eval.store import ResultStore


class LocalEngine:
    """Runs episodes in this process; it takes no arguments."""

    in_process: ClassVar[bool] = True

    def __init__(self, config: EvalConfig) -> None:
        if config.engine_args:
            raise ConfigError(f"engine 'local' takes no arguments: leave out {', '.join(config.engine_args)}")

    @classmethod
    def shared(cls) -> AbstractContextManager[None]:
        """Nothing is shared."""
        return nullcontext()

    def run(
        self, evaluation: Evaluation, store: ResultStore, index: int, on_progress: Callable[[Progress], None]
    ) -> Outcome:
        """Run what has no verdict; see :class:`vecenv_eval.engine.Engine`."""
        planned = frozenset(evaluation.planned)
        loop = EpisodeLoop(
            evaluation.config,
            evaluation.suite,
            evaluation.policy,
            evaluation.simulator,
            FolderSink(store, evaluation.config),
            planned=planned,
            on_progress=on_progress,
            index=index,
        )

        def again(episodes: Collection[Episode]) -> list[Stream]:
            return evaluation.streams(done=planned - frozenset(episodes))

        interrupted = loop.run(evaluation.streams(store.done()), again)
        return Outcome(interrupted=interrupted, causes=tuple(loop.causes))
