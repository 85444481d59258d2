"""Which pixels show which object: from the renderer's instance masks, or by geometry.

The views of one slot and the names of what may be there come in; the same views with a name for each pixel go out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from voxposer.perception.cameras import DepthView
from voxposer.perception.colors import HUES, has_color
from voxposer.perception.config import CameraConfig
from voxposer.perception.geometry import GeometrySegments
from voxposer.perception.seen import ROBOT, LabelledView, Proprioception, SceneMemory


def with_color(labelled: LabelledView, name: str) -> LabelledView:
    """A view in which pixels without a name that have the colour in an object's name are the object's."""
    words = [word for word in name.lower().split("_") if word in HUES]
    if not words or labelled.view.colors is None:
        return labelled
    same = has_color(labelled.view.colors, words[0])
    unnamed = np.array([known == "" for known in labelled.names])[labelled.labels]
    labels = np.where(same & unnamed, labelled.names.index(name), labelled.labels)
    return replace(labelled, labels=labels)


class Segmenter(Protocol):
    """What names pixels."""

    def label(
        self, views: Sequence[DepthView], names: Sequence[str], memory: SceneMemory, robot: Proprioception
    ) -> list[LabelledView]:
        """The views with a name for each pixel.

        Args:
            views: of one slot, now.
            names: of the instances, by the index that masks use; "" is everything without a name.
            memory: of the slot; it is not changed.
            robot: the robot's own state.
        """
        ...


class RendererMasks:
    """The renderer's instance masks: names are known, as in a simulator.

    Args:
        colored: an object that has no pixel in any mask is looked for by the colour in its name, among the pixels
            without a name.
    """

    def __init__(self, *, colored: bool = False) -> None:
        self._colored = colored

    def label(
        self, views: Sequence[DepthView], names: Sequence[str], memory: SceneMemory, robot: Proprioception
    ) -> list[LabelledView]:
        """The views with the names of their masks."""
        del memory, robot
        known = tuple(None if name == ROBOT else name for name in names)
        labelled = [LabelledView(view, view.labels, known) for view in views]
        shown = {known[i] for view in views for i in np.unique(view.labels)}
        for name in (name for name in known if name and name not in shown and self._colored):
            labelled = [with_color(view, name) for view in labelled]
        return labelled


def make_segmenter(config: CameraConfig) -> Segmenter:
    """What names pixels by a config."""
    if config.segmentation == "geometry":
        return GeometrySegments()
    return RendererMasks(colored=config.colored)
