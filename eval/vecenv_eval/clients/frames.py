"""What the slots that ask for actions see: the only place where clients read the environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vecenv.contract import BatchEnv
from vecenv.observations import ImagesUnavailable, Rendered


@dataclass(frozen=True)
class Frames:
    """Observations of some slots; the first axis of every array is the position in ``slots``.

    Attributes:
        slots: which slots of the environment, int [n].
        images: uint8 [n, H, W, 3] by camera; LIBERO's are rotated by 180 degrees against upstream's observations.
        state: proprioception, float32 [n, D].
        instructions: what each slot is told, n strings.
    """

    slots: np.ndarray
    images: Mapping[str, np.ndarray]
    state: np.ndarray
    instructions: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.slots)

    def split(self, most: int) -> list[Frames]:
        """The same in groups of at most ``most`` slots."""
        return [self._part(slice(start, start + most)) for start in range(0, len(self), most)]

    def _part(self, rows: slice) -> Frames:
        images = {name: image[rows] for name, image in self.images.items()}
        return Frames(self.slots[rows], images, self.state[rows], self.instructions[rows])


def observe(env: BatchEnv, slots: np.ndarray, cameras: Sequence[str]) -> Frames:
    """Observe some slots.

    Args:
        env: the environment.
        slots: which slots are wanted, int [n]; the others are not drawn.
        cameras: whose images are wanted.

    Raises:
        ImagesUnavailable: the environment lacks one of the cameras.
    """
    seen = env.observe_egocentric(slots=slots)
    missing = [name for name in cameras if name not in seen.images]
    if missing:
        there = ", ".join(seen.images) or "none"
        raise ImagesUnavailable(f"the policy server wants camera {missing[0]!r}; the environment's cameras: {there}")
    if isinstance(seen.images, Rendered):
        seen.images.prepare(*cameras)
    images = {name: np.ascontiguousarray(seen.images[name][slots]) for name in cameras}
    instructions = env.instructions()
    return Frames(slots, images, np.asarray(seen.state)[slots], tuple(instructions[slot] for slot in slots))
