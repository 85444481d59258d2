"""Which pixels show which object: from the renderer's instance masks, or by geometry.

The views of one slot and the names of what may be there come in; the same views with a name for each pixel go out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from voxposer.perception.cameras import DepthView
from voxposer.perception.config import CameraConfig
from voxposer.perception.seen import LabelledView, Proprioception, SceneMemory

# The instance that renderers call the robot.
ROBOT = "robot"


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
    """The renderer's instance masks: names are known, as in a simulator."""

    def label(
        self, views: Sequence[DepthView], names: Sequence[str], memory: SceneMemory, robot: Proprioception
    ) -> list[LabelledView]:
        """The views with the names of their masks."""
        del memory, robot
        known = tuple(None if name == ROBOT else name for name in names)
        return [LabelledView(view, view.labels, known) for view in views]


def make_segmenter(config: CameraConfig) -> Segmenter:
    """What names pixels by a config."""
    return RendererMasks()
