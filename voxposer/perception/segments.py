"""Which pixels show which object: from the renderer's instance masks, or by geometry.

The views of one slot and the names of what may be there come in; the same views with a name for each pixel go out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Protocol

import numpy as np
from PIL import Image

from voxposer.perception.cameras import DepthView
from voxposer.perception.config import CameraConfig
from voxposer.perception.seen import LabelledView, Proprioception, SceneMemory

# Words for colours and their hues, of a turn; where the first is larger the range goes through 0.
HUES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "red": (0.95, 0.04),
        "orange": (0.04, 0.11),
        "yellow": (0.11, 0.20),
        "green": (0.20, 0.45),
        "blue": (0.50, 0.70),
        "purple": (0.70, 0.82),
        "pink": (0.82, 0.95),
    }
)
# Less saturated or darker than this a pixel has no colour.
_LEAST_SATURATION, _LEAST_VALUE = 0.4, 0.3
# The instance that renderers call the robot.
ROBOT = "robot"


def with_color(labelled: LabelledView, name: str) -> LabelledView:
    """A view in which pixels without a name that have the colour in an object's name are the object's."""
    words = [word for word in name.lower().split("_") if word in HUES]
    if not words or labelled.view.colors is None:
        return labelled
    hue, saturation, value = hsv(labelled.view.colors)
    low, high = HUES[words[0]]
    same = ((hue - low) % 1.0 < (high - low) % 1.0) & (saturation > _LEAST_SATURATION) & (value > _LEAST_VALUE)
    unnamed = np.array([known == "" for known in labelled.names])[labelled.labels]
    labels = np.where(same & unnamed, labelled.names.index(name), labelled.labels)
    return replace(labelled, labels=labels)


def hsv(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Hue, saturation and value, 0 to 1, [H, W] each, of colours uint8 [H, W, 3]."""
    hue, saturation, value = (np.asarray(band, float) / 255 for band in Image.fromarray(colors).convert("HSV").split())
    return hue, saturation, value


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
    return RendererMasks(colored=config.colored)
