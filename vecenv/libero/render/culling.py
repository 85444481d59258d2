"""What a camera sees of a scene: geoms in its image and in mirrors, and whether walls hide the sky.

In: a posed model and the pose of a camera. Out: masks over the model's geoms. MuJoCo draws everything, and what lies
outside the image costs more than what is in it: software GL clips triangles one by one.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from vecenv.libero.render.options import CameraShift, rotation_of

# Groups that upstream draws: 1 holds visual geoms, 2 nothing; 0 are collision geoms. A culled geom moves to 5.
DRAWN_GROUPS, HIDDEN = (1, 2), 5
# Rays per side of the grid that tests whether the sky is visible.
_GRID = 17
# Of so many views it is known whether walls fill them.
_KEPT_VIEWS = 256
# Corners of a box.
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
# Boxes that reach nearer to the camera than this, metres, may cover the whole image.
_NEAREST = 0.02


@dataclass(frozen=True)
class View:
    """One camera of one slot: ``pos`` [3] in metres, ``mat`` [3, 3] (columns right, up, back), ``fovy`` in degrees."""

    pos: np.ndarray
    mat: np.ndarray
    fovy: float

    def shifted(self, shift: CameraShift) -> View:
        """The view moved in its own frame."""
        return View(
            self.pos + self.mat @ np.asarray(shift.pos, float),
            self.mat @ rotation_of(shift.turn),
            float(np.clip(self.fovy + shift.fovy, 1.0, 179.0)),
        )


@dataclass(frozen=True)
class Cone:
    """The region that is visible from a point: points p with ``sides @ (p - apex) <= bounds``, world frame.

    The shapes are [S, 3], [3] and [S].
    """

    sides: np.ndarray
    apex: np.ndarray
    bounds: np.ndarray

    @classmethod
    def of_image(cls, view: View, aspect: float, near: float) -> Cone:
        """The region beyond the near plane of a camera and between the sides of its image."""
        return cls(_side_normals(view, aspect), view.pos, np.array([-near, 0.0, 0.0, 0.0, 0.0]))


class Boxes:
    """The bounding boxes of a model's geoms, for culling what a camera cannot see."""

    def __init__(self, model: mujoco.MjModel) -> None:
        # Of geoms, and for ``area`` of sites, which no side of is longer than their greatest size twice.
        sites = np.repeat(model.site_size.sum(axis=1, keepdims=True), 3, axis=1)
        self._center = np.concatenate([model.geom_aabb[:, :3], np.zeros_like(sites)])
        self._half = np.concatenate([model.geom_aabb[:, 3:], sites])
        # Planes are infinite; MuJoCo gives them the radius 0.
        self._endless = np.concatenate([model.geom_rbound == 0, np.zeros(len(sites), bool)])
        self._drawn = np.flatnonzero(np.isin(model.geom_group, DRAWN_GROUPS))
        self._num_geoms = model.ngeom

    def area(self, poses: np.ndarray, items: np.ndarray, view: View, size: tuple[int, int]) -> mujoco.MjrRect | None:
        """The part of an image that some items may cover; None if one reaches behind the camera or has no end.

        Args:
            poses: of all items, [items, 12].
            items: bool [items].
            view: the camera.
            size: height and width of the image, pixels.
        """
        chosen = np.flatnonzero(items)
        if self._endless[chosen].any():
            return None
        turns = poses[chosen, 3:].reshape(-1, 3, 3)
        corners = self._center[chosen, None] + self._half[chosen, None] * _CORNERS
        points = np.einsum("nij,ncj->nci", turns, corners) + poses[chosen, None, :3]
        x, y, z = np.moveaxis((points - view.pos) @ view.mat, -1, 0)
        if (z > -_NEAREST).any():
            return None
        height, width = size
        scale = height / 2 / np.tan(np.deg2rad(view.fovy) / 2)
        across, up = width / 2 - scale * x / z, height / 2 - scale * y / z
        left, right = _pixels(across, width)
        bottom, top = _pixels(up, height)
        return mujoco.MjrRect(left, bottom, right - left, top - bottom)

    def in_sight(self, data: mujoco.MjData, cone: Cone) -> np.ndarray:
        """Geoms of groups that are drawn whose box is not wholly outside one side of a cone, bool [ngeom]."""
        drawn = self._drawn
        turn = data.geom_xmat[drawn].reshape(-1, 3, 3)
        center = data.geom_xpos[drawn] + (turn @ self._center[drawn, :, None])[..., 0]
        reach = (np.abs(cone.sides @ turn) @ self._half[drawn, :, None])[..., 0]
        distance = (center - cone.apex) @ cone.sides.T
        found = np.zeros(self._num_geoms, bool)
        found[drawn] = self._endless[drawn] | (distance - reach <= cone.bounds).all(axis=1)
        return found


class Mirrors:
    """The reflecting planes and boxes of a model; MuJoCo reflects in the upper side of a box."""

    def __init__(self, model: mujoco.MjModel) -> None:
        flat = np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE))
        shine = np.where(model.geom_matid >= 0, model.mat_reflectance[model.geom_matid], 0.0)
        self._geoms = np.flatnonzero(flat & (shine > 0) & np.isin(model.geom_group, DRAWN_GROUPS))
        self._materials = model.geom_matid.copy()
        self._planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
        self._half = model.geom_size[self._geoms].copy()
        self._half[model.geom_type[self._geoms] == mujoco.mjtGeom.mjGEOM_PLANE, 2] = 0

    def first(self, seen: np.ndarray) -> int:
        """The geom that MuJoCo lets reflect, the first whose material is on a geom that is seen; -1 for none."""
        shining = self._geoms[np.isin(self._materials[self._geoms], self._materials[seen])]
        return int(shining[0]) if len(shining) else -1

    def from_behind(self, data: mujoco.MjData, view: View, drawn: np.ndarray) -> bool:
        """Whether the camera is behind a plane that is drawn, which MuJoCo then lets through."""
        planes = self._planes[drawn[self._planes]]
        normals = data.geom_xmat[planes][:, 2::3]
        return bool((np.einsum("ni,ni->n", normals, view.pos - data.geom_xpos[planes]) < 0).any())

    def cones(self, data: mujoco.MjData, view: View, seen: np.ndarray) -> Iterator[tuple[int, Cone]]:
        """Visible mirrors and what they show: the region seen from the camera's mirror image through their edges."""
        for geom, half in zip(self._geoms, self._half, strict=True):
            turn = data.geom_xmat[geom].reshape(3, 3)
            normal, middle = turn[:, 2], data.geom_xpos[geom] + turn[:, 2] * half[2]
            height = normal @ (view.pos - middle)
            if not seen[geom] or height <= 0:
                continue
            apex = view.pos - 2 * height * normal
            sides, bounds = [-normal], [-height]
            if (half[:2] > 0).all():  # otherwise the mirror is infinite
                corners = middle + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half[:2] @ turn[:, :2].T
                # Edges in turn around +z, seen from below it.
                sides += list(np.cross(np.roll(corners, -1, axis=0) - apex, corners - apex))
                bounds += [0.0] * 4
            yield int(geom), Cone(np.array(sides), apex, np.array(bounds))


class Walls:
    """The opaque, immovable boxes and planes of a model, for leaving out a sky that they hide."""

    def __init__(self, model: mujoco.MjModel) -> None:
        flat = np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE))
        alpha = np.where(model.geom_matid >= 0, model.mat_rgba[model.geom_matid, 3], model.geom_rgba[:, 3])
        still = model.body_weldid[model.geom_bodyid] == 0
        self._geoms = np.flatnonzero(flat & still & np.isin(model.geom_group, DRAWN_GROUPS) & (alpha == 1))
        half = model.geom_size[self._geoms].copy()
        planes = model.geom_type[self._geoms] == mujoco.mjtGeom.mjGEOM_PLANE
        # A plane whose size is 0 is infinite; its third size is the spacing of MuJoCo's grid.
        half[planes] = np.where(half[planes] > 0, half[planes], np.inf)
        half[planes, 2] = 0
        self._half, self._is_plane = half, planes
        self._known: OrderedDict[bytes, bool] = OrderedDict()

    def fill(self, data: mujoco.MjData, view: View, aspect: float) -> bool:
        """Whether all of a grid of rays over the image, its corners included, end at a wall."""
        key = b"".join(
            np.ascontiguousarray(part).tobytes()
            for part in (view.pos, view.mat, [view.fovy, aspect], data.geom_xpos[self._geoms])
        )
        if key not in self._known:
            self._known[key] = self._fill(data, view, aspect)
            if len(self._known) > _KEPT_VIEWS:
                self._known.popitem(last=False)
        return self._known[key]

    def _fill(self, data: mujoco.MjData, view: View, aspect: float) -> bool:
        rays = _image_rays(view, aspect)
        turn = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        eye = np.einsum("nji,nj->ni", turn, view.pos - data.geom_xpos[self._geoms])[:, None]
        way = rays @ turn
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(-self._half[:, None] - eye) / way, (self._half[:, None] - eye) / way])
        # Rays along a face give NaN, which fmin and fmax ignore.
        first, last = np.fmax.reduce(ends.min(axis=0), axis=-1), np.fmin.reduce(ends.max(axis=0), axis=-1)
        # GL draws front faces only: no box from inside, no plane from below.
        front = ~self._is_plane[:, None] | (eye[..., 2] > 0)
        return bool(((first <= last) & (first > 0) & front).any(axis=0).all())


def _pixels(along: np.ndarray, size: int) -> tuple[int, int]:
    """First and last pixel of an image's side, and one more, that points along it lie in; at least one pixel."""
    first, last = int(np.clip(np.floor(along.min()) - 1, 0, size - 1)), int(np.clip(np.ceil(along.max()) + 1, 0, size))
    return first, max(last, first + 1)


def _image_rays(view: View, aspect: float) -> np.ndarray:
    """Directions from the camera to a grid of points over its image, world frame, [rays, 3]."""
    up = np.tan(np.deg2rad(view.fovy) / 2) * np.linspace(-1, 1, _GRID)
    x, y = np.meshgrid(up * aspect, up)
    return np.stack([x.ravel(), y.ravel(), -np.ones(x.size)], axis=1) @ view.mat.T


def _side_normals(view: View, aspect: float) -> np.ndarray:
    """Outward unit normals of near plane, left, right, bottom and top of what a camera sees, world frame, [5, 3]."""
    up = np.tan(np.deg2rad(view.fovy) / 2)
    side = up * aspect
    own = np.array([[0, 0, 1], [-1, 0, side], [1, 0, side], [0, -1, up], [0, 1, up]], float)
    return (own / np.linalg.norm(own, axis=1, keepdims=True)) @ view.mat.T
