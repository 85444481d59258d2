"""The episode recorders that a config asks for: HDF5 recordings, a LeRobot dataset, videos, newest images.

A config and where results go come in; objects that keep ``vecenv_eval.watch.EpisodeRecorder`` go out, recordings first:
what has a verdict does not run again, so whatever is to be kept of an episode is on the disk before its verdict is.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from vecenv.contract import BatchEnv
from vecenv.errors import InvalidFile
from vecenv_eval.config import EvalConfig
from vecenv_eval.environments import make_arguments
from vecenv_eval.episodes import Episode, Suite
from vecenv_eval.live import LivePublisher
from vecenv_eval.simulator import Simulator
from vecenv_eval.sink import Sink
from vecenv_eval.store import Record, StoreError, StoreWriteError
from vecenv_eval.video.episodes import CAMERAS, NONE
from vecenv_eval.watch import EpisodeRecorder, Observable


def make_recorders(config: EvalConfig, suite: Suite, simulator: Simulator, sink: Sink) -> list[EpisodeRecorder]:
    """The recorders of one run; what they cannot write is a ``StoreWriteError``, which ends the run.

    Raises:
        StoreError: there is something else where the LeRobot dataset goes, or it is damaged.
        MissingDependency: a package is not installed.
    """
    recorders: list[EpisodeRecorder] = []
    if config.records:
        from vecenv_eval.demos.options import make_options
        from vecenv_eval.demos.record import DemoRecorder

        options = make_options(simulator.make, suite=suite.name, **make_arguments(config))
        recorders.append(DemoRecorder(sink.add_demos, suite.instructions, options, states=config.record_states))

    def verdicts() -> frozenset[Episode]:
        return frozenset(key for key, record in sink.records().items() if not record.error)

    try:
        recorders += image_recorders(config, sink.folder, verdicts)
    except StoreError:
        raise
    except InvalidFile as error:
        raise StoreError(str(error)) from error
    stored: list[EpisodeRecorder] = [_Storing(recorder, sink.folder) for recorder in recorders]
    if config.live:  # nothing is lost without it, so no failure of its ends the run
        stored.append(LivePublisher(sink.publish, suite.instructions, camera=(*config.camera_names, CAMERAS[0])[0]))
    return stored


def image_recorders(
    config: EvalConfig, folder: Path, verdicts: Callable[[], Collection[Episode]] | None = None
) -> list[EpisodeRecorder]:
    """The recorders that render: a LeRobot dataset and videos, in a results folder.

    Args:
        config: what is recorded.
        folder: the results folder.
        verdicts: gives the episodes that have a verdict on the disk; None where no verdicts are stored.

    Raises:
        DatasetError: there is something else where the LeRobot dataset goes, or it is damaged.
        MissingDependency: a package is not installed.
    """
    recorders: list[EpisodeRecorder] = []
    if config.record_lerobot:
        from vecenv_eval.datasets.lerobot import LeRobotWriter, image_keys

        recorders.append(LeRobotWriter(folder / "lerobot", image_keys(config.camera_names), verdicts))
    if config.video != NONE:
        from vecenv_eval.video.episodes import EpisodeVideos

        recorders.append(EpisodeVideos(folder, config.video, config.camera_names or CAMERAS))
    return recorders


class _Storing:
    """A recorder whose files are results: what cannot be written is an error of the results folder.

    Args:
        recorder: what records.
        folder: the results folder.
    """

    def __init__(self, recorder: EpisodeRecorder, folder: Path) -> None:
        self._recorder, self._folder = recorder, folder

    def begin(self, env: BatchEnv, episodes: Mapping[int, Episode]) -> None:
        """See ``EpisodeRecorder``."""
        with self._errors():
            self._recorder.begin(env, episodes)

    def observe(self, env: Observable, slots: Sequence[int], actions: np.ndarray) -> None:
        """See ``EpisodeRecorder``."""
        with self._errors():
            self._recorder.observe(env, slots, actions)

    def finish(self, env: BatchEnv, records: Mapping[int, Record]) -> None:
        """See ``EpisodeRecorder``."""
        with self._errors():
            self._recorder.finish(env, records)

    def close(self) -> None:
        """See ``EpisodeRecorder``."""
        with self._errors():
            self._recorder.close()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:  # some name their file; others concern what is being encoded below the folder
            where = error.filename if isinstance(error.filename, str) else self._folder
            raise StoreWriteError(f"{where} cannot be written: {error.strerror or error}") from error
