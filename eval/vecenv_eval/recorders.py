"""The episode recorders that a config asks for: HDF5 recordings, a LeRobot dataset, videos.

A config and where results go come in; objects that keep ``vecenv_eval.watch.EpisodeRecorder`` go out, recordings first:
what has a verdict does not run again, so whatever is to be kept of an episode is on the disk before its verdict is.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

from vecenv_eval.config import EvalConfig
from vecenv_eval.environments import make_arguments
from vecenv_eval.episodes import Episode, Suite
from vecenv_eval.simulator import Simulator
from vecenv_eval.sink import Sink
from vecenv_eval.video.episodes import NONE
from vecenv_eval.watch import EpisodeRecorder


def make_recorders(config: EvalConfig, suite: Suite, simulator: Simulator, sink: Sink) -> list[EpisodeRecorder]:
    """The recorders of one run.

    Raises:
        DatasetError: there is something else where the LeRobot dataset goes.
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

    return [*recorders, *image_recorders(config, sink.folder, verdicts)]


def image_recorders(
    config: EvalConfig, folder: Path, verdicts: Callable[[], Collection[Episode]] | None = None
) -> list[EpisodeRecorder]:
    """The recorders that render: a LeRobot dataset and videos, in a results folder; errors as of `make_recorders`.

    Args:
        config: what is recorded.
        folder: the results folder.
        verdicts: gives the episodes that have a verdict on the disk; None where no verdicts are stored.
    """
    recorders: list[EpisodeRecorder] = []
    if config.record_lerobot:
        from vecenv_eval.datasets.lerobot import LeRobotWriter, image_keys

        recorders.append(LeRobotWriter(folder / "lerobot", image_keys(config.camera_names), verdicts))
    if config.video != NONE:
        from vecenv_eval.video.episodes import CAMERAS, EpisodeVideos

        recorders.append(EpisodeVideos(folder, config.video, config.camera_names or CAMERAS))
    return recorders
