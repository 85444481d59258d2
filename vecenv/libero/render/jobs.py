"""What is asked of a renderer and what it gives: shots, images, and the tasks that a call is divided into."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vecenv.libero.render.culling import View
from vecenv.libero.render.drawing import Pose, Stage
from vecenv.libero.render.options import RenderError, UserCamera, VisualOptions
from vecenv.observations import CameraView


@dataclass(frozen=True)
class Shot:
    """What to render of one slot: the index of its stage, its pose, and its visual options."""

    stage: int
    pose: Pose
    options: VisualOptions = field(default_factory=VisualOptions)


@dataclass(frozen=True)
class Wanted:
    """Which images of a camera to render."""

    rgb: bool = True
    depth: bool = False
    segmentation: bool = False


@dataclass(frozen=True)
class Frames:
    """Images of B slots by camera, as delivered: rows from the top, mirrored.

    Attributes:
        rgb: uint8 [B, H, W, 3].
        depth: metres from the camera's plane, float32 [B, H, W].
        segmentation: index into the stage's ``instances``, int16 [B, H, W].
        views: where the cameras are.
    """

    rgb: Mapping[str, np.ndarray]
    depth: Mapping[str, np.ndarray]
    segmentation: Mapping[str, np.ndarray]
    views: Mapping[str, CameraView]


class Task(NamedTuple):
    """Some cameras of one slot."""

    slot: int
    cameras: range


class Arrays(NamedTuple):
    """The arrays that a job's images go to, by camera; see ``Frames`` for their shapes."""

    rgb: dict[str, np.ndarray]
    depth: dict[str, np.ndarray]
    segmentation: dict[str, np.ndarray]

    @classmethod
    def new(cls, layout: Layout) -> Arrays:
        """New arrays."""
        made = cls({}, {}, {})
        for name, kind, dtype, shape in layout.parts():
            getattr(made, kind)[name] = np.empty(shape, dtype)
        return made

    @classmethod
    def over(cls, memory: np.ndarray, layout: Layout) -> Arrays:
        """Arrays that lie one after the other in memory, uint8 [at least ``layout.bytes``]."""
        made, begin = cls({}, {}, {}), 0
        for name, kind, dtype, shape in layout.parts():
            end = begin + math.prod(shape) * np.dtype(dtype).itemsize
            getattr(made, kind)[name] = memory[begin:end].view(dtype).reshape(shape)
            begin = end
        return made


class Layout(NamedTuple):
    """What decides the arrays of a job: the names of its cameras, the images wanted, the number of slots, and sizes."""

    names: tuple[str, ...]
    wanted: Wanted
    slots: int
    height: int
    width: int

    def parts(self) -> Iterator[tuple[str, str, type, tuple[int, ...]]]:
        """Camera, kind, type and shape of every array; larger elements come first, so that all are aligned."""
        size = (self.slots, self.height, self.width)
        for kind, dtype, shape in (
            ("depth", np.float32, size),
            ("segmentation", np.int16, size),
            ("rgb", np.uint8, (*size, 3)),
        ):
            if getattr(self.wanted, kind):
                for name in self.names:
                    yield name, kind, dtype, shape

    @property
    def bytes(self) -> int:
        """Size of all arrays together."""
        return sum(math.prod(shape) * np.dtype(dtype).itemsize for _, _, dtype, shape in self.parts())


@dataclass
class Job:
    """One call of ``GlRenderer.render``, or the part of it that a process draws.

    Attributes:
        shots: by slot.
        cameras: what every slot is drawn through.
        wanted: which images.
        arrays: where they go.
        views: where the cameras were, by name and slot; None until the image is drawn.
    """

    shots: Mapping[int, Shot]
    cameras: Sequence[str | UserCamera]
    wanted: Wanted
    arrays: Arrays
    views: dict[str, list[View | None]]

    @classmethod
    def of(cls, shots: Mapping[int, Shot], cameras: Sequence[str | UserCamera], layout: Layout, arrays: Arrays) -> Job:
        """A job of which nothing is drawn."""
        return cls(shots, cameras, layout.wanted, arrays, {name: [None] * layout.slots for name in layout.names})

    def frames(self) -> Frames:
        """The images, all of which must be drawn."""
        height, width = next(iter(itertools.chain(*(kind.values() for kind in self.arrays)))).shape[1:3]
        views = {
            name: camera_view([view for view in row if view is not None], height, width)
            for name, row in self.views.items()
            if row
        }
        return Frames(*self.arrays, views)

    def add_views(self, views: Mapping[str, Sequence[View | None]]) -> None:
        """Add the views of what another process has drawn."""
        for name, row in views.items():
            for slot, view in enumerate(row):
                if view is not None:
                    self.views[name][slot] = view

    def shares(self, count: int) -> list[list[Task]]:
        """All tasks, divided between so many painters; slots of one scene go to the same painter where they can."""
        order = sorted(self.shots, key=lambda slot: self.shots[slot].stage)
        # With few slots a task is one image, so that every painter gets one.
        each = 1 if len(order) < 2 * count else len(self.cameras)
        tasks = [
            Task(slot, range(first, min(first + each, len(self.cameras))))
            for slot in order
            for first in range(0, len(self.cameras), each)
        ]
        bounds = np.linspace(0, len(tasks), count + 1).astype(int)
        return [tasks[low:high] for low, high in itertools.pairwise(bounds.tolist())]


def check_request(
    stages: Sequence[Stage],
    shots: Sequence[Shot],
    cameras: Sequence[str | UserCamera],
    layout: Layout,
    out: Mapping[str, np.ndarray],
) -> None:
    """Check that scenes have what is asked of them, and that arrays given for colours fit.

    Raises:
        RenderError: they do not.
    """
    for stage, options in {(shot.stage, id(shot.options)): (shot.stage, shot.options) for shot in shots}.values():
        stages[stage].check(cameras, options)
    size = (layout.slots, layout.height, layout.width, 3)
    for name, array in out.items():
        if array.shape != size or array.dtype != np.uint8:
            raise RenderError(f"out[{name!r}] is {array.dtype} {array.shape}; expected uint8 {size}")


def camera_view(views: Sequence[View], height: int, width: int) -> CameraView:
    """The contract's ``CameraView`` of a camera, from the views of B slots."""
    focal = np.array([height / 2 / np.tan(np.deg2rad(view.fovy) / 2) for view in views])
    matrices = np.zeros((len(views), 3, 3))
    # Delivered images are mirrored: x grows to the camera's left.
    matrices[:, 0, 0], matrices[:, 1, 1], matrices[:, 2, 2] = -focal, focal, 1.0
    matrices[:, 0, 2], matrices[:, 1, 2] = (width - 1) / 2, (height - 1) / 2
    # MuJoCo's camera axes are right, up, back; the contract's right, down, forward.
    rotations = np.stack([view.mat for view in views]) * np.array([1.0, -1.0, -1.0])
    return CameraView(intrinsics=matrices, pos=np.stack([view.pos for view in views]), mat=rotations)


def camera_name(camera: str | UserCamera) -> str:
    """The name of a camera in the images."""
    return camera if isinstance(camera, str) else camera.name
