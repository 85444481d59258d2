"""What environments return about their scenes: camera images and proprioception, and ground truth for planners.

``Egocentric`` is what ``observe_egocentric`` returns, ``Objects`` what ``observe_objects`` returns. Arrays are NumPy,
lengths are metres, angles radians, poses are in the world frame, quaternions are wxyz. Axes of size B are slots.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from vecenv.errors import InvalidInput, NotFound

if TYPE_CHECKING:
    import jax


class ImagesUnavailable(NotFound):
    """An observation does not have the requested image; the message names it and those that exist."""


class UnknownCamera(ImagesUnavailable, KeyError):
    """A camera that does not exist; the message lists those that do."""


@dataclass(frozen=True)
class CameraView:
    """Where a camera of each slot is, and how it maps directions to pixels of the delivered image.

    Attributes:
        intrinsics: camera matrices [B, 3, 3]: ``intrinsics @ p`` is proportional to (x, y, 1) for a point p in the
            camera's frame; pixel centres are at whole numbers, x counts columns and y rows from the top left.
            LIBERO's x entry is negative: its delivered images are mirrored, as VLA training data are.
        pos: position in metres, world frame, [B, 3].
        mat: rotation to the world frame, [B, 3, 3]; columns are the camera's right, down and forward.
    """

    intrinsics: np.ndarray
    pos: np.ndarray
    mat: np.ndarray


_Shown = TypeVar("_Shown")
# Upstream's names of the two policy cameras and of their images.
_CAMERA_ALIASES: Mapping[str, str] = MappingProxyType(
    {
        "agentview_image": "agentview",
        "wrist_image": "wrist",
        "robot0_eye_in_hand": "wrist",
        "robot0_eye_in_hand_image": "wrist",
    }
)


def choose_cameras(names: Sequence[str], there: Sequence[str]) -> tuple[str, ...]:
    """Some cameras by name, in the order asked for; LIBERO's names of the two policy cameras work as well.

    Args:
        names: the cameras asked for.
        there: the cameras there are.

    Raises:
        UnknownCamera: one of them does not exist; the message names it and those that do.
        InvalidInput: none is asked for, or one twice.
    """
    if isinstance(names, str) or not names:
        raise InvalidInput(f"cameras={names!r}: give some of {', '.join(there)}, as a sequence of names")
    aliased = [_CAMERA_ALIASES.get(name, name) for name in names]
    chosen = [alias if alias in there else name for alias, name in zip(aliased, names, strict=True)]
    for name in chosen:
        if name not in there:
            raise UnknownCamera(f"there is no camera {name!r}; cameras: {', '.join(there)}")
        if chosen.count(name) > 1:
            raise InvalidInput(f"cameras={list(names)}: {name!r} is named twice")
    return tuple(chosen)


class Rendered(Mapping[str, _Shown]):
    """Images (or anything else) by camera, each made when it is first read and kept.

    LIBERO's names work as well: ``images["agentview_image"]`` is ``images["agentview"]``, and
    ``images["robot0_eye_in_hand_image"]`` is ``images["wrist"]``. Another name raises ``UnknownCamera``.

    Args:
        names: the cameras.
        render: makes the images of several cameras in one call.
    """

    def __init__(self, names: Iterable[str], render: Callable[[Sequence[str]], Mapping[str, _Shown]]) -> None:
        self._names, self._render = tuple(names), render
        self._made: dict[str, _Shown] = {}

    def prepare(self, *names: str) -> None:
        """Make several in one call, which takes less time than one call each."""
        known = [self._canonical(name) for name in names if name in self]
        missing = [name for name in known if name not in self._made]
        if missing:
            self._made.update(self._render(missing))

    def __getitem__(self, name: str) -> _Shown:
        if name not in self:
            raise UnknownCamera(f"there is no camera {name!r}; cameras: {', '.join(self._names) or 'none'}")
        self.prepare(name)
        return self._made[self._canonical(name)]

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and self._canonical(name) in self._names

    def _canonical(self, name: str) -> str:
        return name if name in self._names else _CAMERA_ALIASES.get(name, name)

    def __repr__(self) -> str:
        return f"Rendered(cameras: {', '.join(self._names) or 'none'})"

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _no_cameras() -> Rendered[jax.Array]:
    return Rendered((), lambda names: {})


@dataclass(frozen=True)
class Egocentric:
    """``observe_egocentric``'s return. Mappings are by camera and may render when they are first read.

    Attributes:
        state: proprioception, float32. LIBERO [B, 8]: end-effector position, axis-angle orientation, two finger
            positions. SIMPLER [B, 23] (WidowX) or [B, 29] (Google Robot): joint positions, joint velocities, pose of
            the base (xyz, wxyz).
        images: camera images, uint8 [B, H, W, 3]. LIBERO's are rotated by 180 degrees against upstream's observations,
            as VLA training data are; SIMPLER's are as upstream's. Empty when the environment does not render.
        depths: distances from the camera's plane, metres, float32 [B, H, W], pixel by pixel with ``images``.
        segmentations: index into ``instances[slot]`` of what each pixel shows, int16 [B, H, W], pixel by pixel with
            ``images``.
        images_device, depths_device, segmentations_device: the same as JAX arrays on the device that rendered them,
            without a copy through the host; any library takes them by DLPack, such as ``torch.from_dlpack``. For
            rays (``RenderConfig(engine="raytrace")``); where GL renders, reading one raises ``GlError``.
        views: where the cameras are.
        instances: visible things of each slot, B tuples of names; "" is everything without a name.
        pose: navigation pose; always None for manipulation.
    """

    state: np.ndarray
    images: Mapping[str, np.ndarray] = field(default_factory=dict)
    depths: Mapping[str, np.ndarray] = field(default_factory=dict)
    segmentations: Mapping[str, np.ndarray] = field(default_factory=dict)
    images_device: Mapping[str, jax.Array] = field(default_factory=_no_cameras)
    depths_device: Mapping[str, jax.Array] = field(default_factory=_no_cameras)
    segmentations_device: Mapping[str, jax.Array] = field(default_factory=_no_cameras)
    views: Mapping[str, CameraView] = field(default_factory=dict)
    instances: tuple[tuple[str, ...], ...] = ()
    pose: None = None

    @property
    def rgb(self) -> np.ndarray:
        """The third-person camera's image, [B, H, W, 3]; raises ``ImagesUnavailable`` without rendering."""
        return _camera(self.images, "agentview", "image")

    @property
    def agentview_image(self) -> np.ndarray:
        """LIBERO's name for ``rgb``."""
        return self.rgb

    @property
    def wrist_image(self) -> np.ndarray:
        """The wrist camera's image, [B, H, W, 3]; raises ``ImagesUnavailable`` without rendering.

        SIMPLER has no wrist camera: it is None, and ``observation`` is the third-person image alone.
        """
        return _camera(self.images, "wrist", "image")

    @property
    def observation(self) -> list[np.ndarray]:
        """The two camera images in the order policies expect: third-person, wrist."""
        if isinstance(self.images, Rendered):
            self.images.prepare("agentview", "wrist")
        return [self.rgb, self.wrist_image]

    @property
    def depth(self) -> np.ndarray:
        """The third-person camera's depth, [B, H, W]; raises ``ImagesUnavailable`` without rendering."""
        return _camera(self.depths, "agentview", "depth image")

    @property
    def segmentation(self) -> np.ndarray:
        """The third-person camera's instances, [B, H, W]; raises ``ImagesUnavailable`` without rendering."""
        return _camera(self.segmentations, "agentview", "segmentation image")

    @property
    def intrinsics(self) -> np.ndarray | None:
        """The third-person camera's matrices, [B, 3, 3]; None where there are no cameras."""
        return self.views["agentview"].intrinsics if "agentview" in self.views else None

    def points_from_pixels(self, camera: str, xy: np.ndarray) -> np.ndarray:
        """Points in the world that pixels show, metres, float64 [B, N, 3].

        Args:
            camera: a camera's name.
            xy: columns and rows in the delivered image, int [N, 2] for all slots or [B, N, 2].

        Raises:
            ImagesUnavailable: there is no such camera.
            IndexError: a pixel outside the image.
        """
        depth, view = _camera(self.depths, camera, "depth image"), _camera(self.views, camera, "view")
        batch, height, width = depth.shape
        pixels = np.asarray(xy)
        pixels = np.broadcast_to(pixels, (batch, *pixels.shape[-2:]))
        x, y = pixels[..., 0].astype(int), pixels[..., 1].astype(int)
        if ((x < 0) | (x >= width) | (y < 0) | (y >= height)).any():
            raise IndexError(f"a pixel lies outside the image of {width} x {height}")
        rays = np.stack([pixels[..., 0], pixels[..., 1], np.ones(x.shape)], axis=-1)
        rays = rays @ np.linalg.inv(view.intrinsics).transpose(0, 2, 1)
        points = rays * depth[np.arange(batch)[:, None], y, x, None]
        return points @ view.mat.transpose(0, 2, 1) + view.pos[:, None]


def _camera(found: Mapping[str, _Shown], name: str, what: str) -> _Shown:
    if name not in found:
        there = f"available: {', '.join(found)}" if found else "this environment renders nothing; `state` is available"
        raise ImagesUnavailable(f"no {what} of camera {name!r}: {there}")
    return found[name]


@dataclass(frozen=True)
class PointCloud:
    """Surface samples of an object or part: ``points`` [N, 3] and outward unit ``normals`` [N, 3], world frame."""

    points: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True)
class RegionBox:
    """A named place: a box with centre ``pos`` [3], rotation ``mat`` [3, 3] and ``half_extents`` [3], in metres.

    ``parent`` is the object or fixture it belongs to, None for a place on the table or floor. ``axis`` is the axis
    along which the part that carries it slides (of a drawer; unit vector [3]), None if nothing slides. World frame.
    """

    pos: np.ndarray
    mat: np.ndarray
    half_extents: np.ndarray
    parent: str | None = None
    axis: np.ndarray | None = None


@dataclass(frozen=True)
class PartJoint:
    """The joint that moves a part.

    Attributes:
        kind: ``"slide"`` or ``"hinge"``.
        axis: direction in which the part slides to open; or the axis about which it turns, counterclockwise seen from
            its tip, to open or switch on. Unit vector, world frame, [3].
        anchor: a point on the axis, world frame, [3].
        travel: how far it opens, metres or radians.
        opened: how far it is open now, metres or radians; 0 is closed or off.
    """

    kind: str
    axis: np.ndarray
    anchor: np.ndarray
    travel: float
    opened: float


@dataclass(frozen=True)
class Part:
    """A named part of an object or fixture: a drawer, a handle, a door, a knob, a top, a space.

    Attributes:
        parent: the object or fixture it belongs to.
        kind: ``"drawer"``, ``"door"``, ``"handle"``, ``"knob"``, ``"top"`` (things stand on it) or ``"space"``
            (things go into it).
        cloud: surface samples.
        box: the region it is, or that moves with it; None if there is no region.
        joint: the joint that moves it; None for a fixed part.
    """

    parent: str
    kind: str
    cloud: PointCloud
    box: RegionBox | None = None
    joint: PartJoint | None = None


@dataclass(frozen=True)
class ObjectsSnapshot:
    """Ground truth of one slot, as planners read it.

    Attributes:
        names: names of the movable objects, then of the fixtures, as in the task's file.
        objects: name -> surface samples of its collision geometry.
        poses: name -> pose of its origin, xyz + wxyz, [7]; goals are stated about origins.
        regions: name -> box, the regions that goals refer to.
        goal: the task's predicates, e.g. ``("on", "bowl_1", "plate_1")``; all must hold.
        scene: surface samples of everything that collides, the robot excluded.
        ee_pose: end-effector pose, xyz + wxyz, [7].
        gripper: the two finger positions in metres, [2].
        workspace: lower and upper corner of the workspace, [2, 3].
        targets: objects of interest of the task (``obj_of_interest``).
        movable: the names that are not fixed to the world.
        parts: name -> part of one of them; LIBERO's are named as ``vecenv.libero.scene.parts`` says.
        panda_base: pose of the base of a Panda, xyz + wxyz, [7]; None for another robot.
    """

    names: tuple[str, ...]
    objects: dict[str, PointCloud]
    poses: dict[str, np.ndarray]
    regions: dict[str, RegionBox]
    goal: tuple[tuple[str, ...], ...]
    scene: PointCloud
    ee_pose: np.ndarray
    gripper: np.ndarray
    workspace: np.ndarray
    targets: tuple[str, ...] = ()
    movable: tuple[str, ...] = ()
    parts: Mapping[str, Part] = field(default_factory=dict)
    panda_base: np.ndarray | None = None


@dataclass(frozen=True)
class Objects:
    """``observe_objects``'s return: one snapshot per slot, and why one is missing.

    Attributes:
        snapshot: B snapshots; None if ``error`` gives a reason.
        error: B strings, empty if there is a snapshot.
    """

    snapshot: tuple[ObjectsSnapshot | None, ...]
    error: tuple[str, ...]
