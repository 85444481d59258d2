"""What stands still in front of a fixed camera, and so need not be drawn again.

In: what there is to see, image after image of one slot and camera. Out: a plan for each image: which items the layer
holds, a stored image with depth that the others are drawn over, and whether the layer must be drawn first. Items are in
the layer while their poses are equal to the bit, so what is drawn depends on the slot's state alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vecenv.libero.render.drawing import Sight
from vecenv.libero.render.options import VisualOptions

# After so many images in the same pose an item goes back into the layer: a new layer costs about as much as the rest of
# the objects over so many images.
SETTLED = 8


@dataclass(frozen=True)
class Plan:
    """How to draw an image.

    Attributes:
        held: the items that the layer holds, bool [items]; None if the image has no layer.
        is_new: whether the layer must be drawn.
    """

    held: np.ndarray | None = None
    is_new: bool = False


class Stillness:
    """The history of one camera of one slot."""

    def __init__(self) -> None:
        self._sight: Sight | None = None
        self._options = VisualOptions()
        self._still = np.zeros(0, int)
        self._held: np.ndarray | None = None

    def plan(self, sight: Sight, options: VisualOptions) -> Plan:
        """How to draw the next image; whoever asks then draws it so."""
        before, self._sight = self._sight, sight
        if before is None or not self._is_comparable(before, sight, options):
            self._options, self._still, self._held = options, np.zeros(len(sight.poses), int), None
            return Plan()
        moved = (sight.poses != before.poses).any(axis=1)
        self._still = np.where(moved, 0, self._still + 1)
        settled = sight.in_image & (self._still >= SETTLED)
        if self._held is None:
            return self._begin(sight.in_image & ~moved)
        kept = self._held & sight.in_image & ~moved
        if (kept == self._held).all() and not (settled & ~self._held).any():
            return Plan(self._held)
        return self._begin(kept | settled)

    def forget(self) -> None:
        """Begin anew."""
        self._sight, self._held = None, None

    def _begin(self, held: np.ndarray) -> Plan:
        self._held = held if held.any() else None
        return Plan(self._held, is_new=self._held is not None)

    def _is_comparable(self, before: Sight, now: Sight, options: VisualOptions) -> bool:
        a, b = before.view, now.view
        return (
            (a.pos == b.pos).all()
            and (a.mat == b.mat).all()
            and a.fovy == b.fovy
            and len(before.poses) == len(now.poses)
            and (options is self._options or options == self._options)
        )
