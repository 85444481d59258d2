"""Depth images as points: what one camera of one slot saw, and whether it sees through a point in space.

``observe_egocentric``'s depth images, masks and camera matrices come in; a :class:`DepthView` for each camera of a slot
comes out. Its points and normals are organised as the image is, [H, W, 3], metres, world frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from vecenv.observations import Egocentric

# A depth beyond this, metres, shows nothing: the sky, or the far plane of the renderer.
_FARTHEST = 10.0


@dataclass(frozen=True)
class DepthView:
    """What one camera of one slot saw.

    Attributes:
        camera: its name.
        intrinsics: camera matrix of the image after leaving out pixels, [3, 3].
        pos: of the camera, metres, world frame, [3].
        mat: its rotation, [3, 3]; columns are right, down and forward.
        depth: distances from the camera's plane, metres, [H, W].
        points: what each pixel shows, metres, world frame, [H, W, 3].
        labels: index of the instance that each pixel shows, int [H, W]; all zero without masks.
        colors: red, green and blue of each pixel, uint8 [H, W, 3]; None where they were not asked for.
    """

    camera: str
    intrinsics: np.ndarray
    pos: np.ndarray
    mat: np.ndarray
    depth: np.ndarray
    points: np.ndarray
    labels: np.ndarray
    colors: np.ndarray | None = None

    @cached_property
    def valid(self) -> np.ndarray:
        """Pixels that show something, bool [H, W]."""
        shown = np.isfinite(self.depth) & (self.depth > 1e-4) & (self.depth < _FARTHEST)
        return shown & np.isfinite(self.points).all(axis=2)

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normals of what each pixel shows, towards the camera, [H, W, 3].

        From the differences to the nearer of the two neighbours along each axis of the image, so that a pixel at the
        edge of an object does not take the background into account.
        """
        across = np.cross(_nearer_difference(self.points, 1), _nearer_difference(self.points, 0))
        length = np.linalg.norm(across, axis=2, keepdims=True)
        normals = across / np.maximum(length, 1e-12)
        away = (normals * (self.points - self.pos)).sum(axis=2, keepdims=True) > 0
        return np.where(away, -normals, normals)

    def sees_through(self, points: np.ndarray, tolerance: float) -> np.ndarray:
        """Which points [N, 3] are in front of all that is seen around their pixel, so that nothing can be there.

        Args:
            points: world frame, metres.
            tolerance: how far in front, metres.

        Returns:
            bool [N]; False for a point outside the image or behind the camera.
        """
        return self._compared(points, self._nearest, tolerance)

    def shows(self, points: np.ndarray, tolerance: float) -> np.ndarray:
        """Which points [N, 3] are in the image and not hidden behind something, bool [N]."""
        return self._compared(points, self._farthest, -tolerance)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where points [N, 3] are in the image.

        Returns:
            Row and column, int [N], 0 for those outside the image; distance from the camera's plane, metres, [N]; and
            which are in the image, bool [N].
        """
        local = (points - self.pos) @ self.mat
        ahead = local[:, 2] > 1e-3
        pixel = local @ self.intrinsics.T
        xy = np.round(pixel[:, :2] / np.where(ahead, pixel[:, 2], 1.0)[:, None])
        height, width = self.depth.shape
        inside = ahead & (xy >= 0).all(axis=1) & (xy < [width, height]).all(axis=1)
        column, row = np.where(inside[:, None], xy, 0).astype(int).T
        return row, column, local[:, 2], inside

    def _compared(self, points: np.ndarray, depth: np.ndarray, margin: float) -> np.ndarray:
        """Which points are nearer than a depth image by a margin, metres."""
        row, column, distance, inside = self.project(points)
        return inside & (distance < depth[row, column] - margin)

    @cached_property
    def _nearest(self) -> np.ndarray:
        return minimum_filter(np.where(self.valid, self.depth, _FARTHEST), size=3, mode="nearest")

    @cached_property
    def _farthest(self) -> np.ndarray:
        return maximum_filter(np.where(self.valid, self.depth, _FARTHEST), size=3, mode="nearest")


def depth_views(
    seen: Egocentric, cameras: Sequence[str], slots: Sequence[int], *, masks: bool, colors: bool, largest: int
) -> list[list[DepthView]]:
    """The views of several slots.

    Args:
        seen: the observation; the images of these cameras are rendered here.
        cameras: their names.
        slots: which slots.
        masks: whether instance masks are read.
        colors: whether colours are read.
        largest: side of an image, pixels; of larger ones only every second, third, ... row and column is used.

    Returns:
        For each of ``slots``, one view for each of ``cameras``.

    Raises:
        ImagesUnavailable: there is no such camera.
    """
    views: list[list[DepthView]] = [[] for _ in slots]
    for camera in cameras:
        depth = seen.depths[camera]
        step = -(-max(depth.shape[1:]) // largest)
        rows, columns = np.arange(0, depth.shape[1], step), np.arange(0, depth.shape[2], step)
        xy = np.stack(np.meshgrid(columns, rows), axis=-1)
        points = seen.points_from_pixels(camera, xy.reshape(-1, 2))
        labels = seen.segmentations[camera] if masks else None
        images = seen.images[camera] if colors else None
        scale = np.diag([1 / step, 1 / step, 1.0])
        view = seen.views[camera]
        for own, slot in zip(views, slots, strict=True):
            own.append(
                DepthView(
                    camera=camera,
                    intrinsics=scale @ view.intrinsics[slot],
                    pos=view.pos[slot],
                    mat=view.mat[slot],
                    depth=np.asarray(depth[slot, ::step, ::step], float),
                    points=points[slot].reshape(*xy.shape[:2], 3),
                    labels=np.zeros(xy.shape[:2], int) if labels is None else labels[slot, ::step, ::step].astype(int),
                    colors=None if images is None else images[slot, ::step, ::step],
                )
            )
    return views


def _nearer_difference(points: np.ndarray, axis: int) -> np.ndarray:
    """Difference of each point to its next or previous neighbour along an axis of the image, the shorter, [H, W, 3]."""
    step = np.diff(points, axis=axis)
    edge = np.full_like(np.take(step, [0], axis=axis), np.inf)
    after, before = np.concatenate([step, edge], axis=axis), np.concatenate([edge, step], axis=axis)
    nearer = np.linalg.norm(after, axis=2) <= np.linalg.norm(before, axis=2)
    return np.where(nearer[..., None], after, before)
