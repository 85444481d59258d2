"""The objects of one slot as its cameras saw them, with a memory of what is hidden now.

Depth views with a name for each pixel and the pose of the hand come in, once a round; an
:class:`~vecenv.observations.ObjectsSnapshot` made of seen points alone goes out, which grasping, placing and planning
read as they read ground truth. Its names are those that were seen; poses are the middle of the box around an object
over its lowest point, unrotated; there are no regions, no goal, and no parts but those of ``seen_parts``.

What is hidden now is where it was seen last. An object through whose remembered points a camera sees has moved: its
memory is dropped. What the hand has grasped moves with it, as it was seen before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree

from vecenv.errors import NotFound
from vecenv.manipulation.world import matrix
from vecenv.observations import ObjectsSnapshot, PointCloud
from voxposer.perception import points as clouds
from voxposer.perception.cameras import DepthView
from voxposer.perception.config import PerceptionConfig
from voxposer.perception.seen_parts import parts_of

# The instance that renderers call the robot.
ROBOT = "robot"
# Scenery is sampled so: the table, and what stands out of it. Metres.
_TABLE_VOXEL, _SCENERY_VOXEL = 0.02, 0.01
# Share of the points of a grasped object through which cameras must see before it is not believed to be held.
_NOT_HELD = 0.4


class NotSeen(NotFound):
    """The cameras do not see what is needed; the message names it and the cameras."""


@dataclass(frozen=True)
class Proprioception:
    """What the robot knows about itself.

    Attributes:
        ee_pose: of the grip site, xyz + wxyz, world frame, [7].
        gripper: the two finger positions, metres, [2].
        closed: whether the last command closed the hand.
    """

    ee_pose: np.ndarray
    gripper: np.ndarray
    closed: bool


@dataclass(frozen=True)
class LabelledView:
    """A view and the name of each pixel: ``names[view.labels]``; "" is no object, None the robot."""

    view: DepthView
    labels: np.ndarray
    names: tuple[str | None, ...]

    def of(self, name: str | None) -> PointCloud:
        """What the pixels with a name show."""
        ids = [i for i, known in enumerate(self.names) if known == name]
        rows = np.isin(self.labels, ids) & self.view.valid
        return PointCloud(self.view.points[rows], self.view.normals[rows])


@dataclass
class SceneMemory:
    """What one slot has seen since its episode began.

    Attributes:
        config: options.
        base: position of the robot's base, [2].
        table: height of the table; None before the first look.
        seen: by name, seen surface of the objects, world frame.
        whole: by name, the same completed.
        held: name of the grasped object and its completed surface in the hand's frame; None for none.
    """

    config: PerceptionConfig
    base: np.ndarray
    table: float | None = None
    seen: dict[str, PointCloud] = field(default_factory=dict)
    whole: dict[str, PointCloud] = field(default_factory=dict)
    held: tuple[str, PointCloud] | None = None

    def look(self, labelled: Sequence[LabelledView], robot: Proprioception) -> ObjectsSnapshot:
        """The snapshot of now.

        Raises:
            NotSeen: no table is seen.
        """
        background = clouds.joined([view.of("") for view in labelled])
        if self.table is None:
            self.table = table_height(self.inside(clouds.joined([background, *self._everything(labelled)])))
        self._update_held(labelled, robot)
        self._update_seen(labelled)
        scenery = self._scenery(background)
        self._complete([view.view for view in labelled], scenery)
        if self.held is not None:
            name, model = self.held
            self.whole[name] = _moved(model, matrix(robot.ee_pose[3:]), robot.ee_pose[:3])
        return self._snapshot(scenery, robot)

    # -- memory --------------------------------------------------------------------------------------------------------

    def _everything(self, labelled: Sequence[LabelledView]) -> list[PointCloud]:
        return [view.of(name) for view in labelled for name in set(view.names) if name]

    def _update_held(self, labelled: Sequence[LabelledView], robot: Proprioception) -> None:
        """Find out what the hand holds, by what was seen between its pads before they closed."""
        gap = float(robot.gripper[0] - robot.gripper[1])
        if not robot.closed or gap < self.config.closed_gap:
            if self.held is not None:
                self._forget(self.held[0])
            self.held = None
            return
        if self.held is None:
            self.held = self._grasped(robot, gap)
        if self.held is not None:
            name, model = self.held
            now = _moved(model, matrix(robot.ee_pose[3:]), robot.ee_pose[:3])
            wrong = clouds.seen_through(now.points, [v.view for v in labelled], 2 * self.config.camera.tolerance)
            if wrong.mean() > _NOT_HELD:
                self._forget(name)
                self.held = None

    def _grasped(self, robot: Proprioception, gap: float) -> tuple[str, PointCloud] | None:
        """The object between the pads, centred between them as the pads do, in the hand's frame; None for none."""
        rotation, pos = matrix(robot.ee_pose[3:]), robot.ee_pose[:3]
        along, spare, out = self.config.held_box
        half = np.array([along, self.config.margins.gripper.half_opening + spare, out])
        best: tuple[int, str, PointCloud] | None = None
        for name, cloud in self.whole.items():
            if self._is_fixed(cloud):
                continue
            local = PointCloud((cloud.points - pos) @ rotation, cloud.normals @ rotation)
            between = (np.abs(local.points) < half).all(axis=1)
            if not between.any() or (best is not None and between.sum() <= best[0]):
                continue
            across = local.points[between, 1]
            shift = np.array([0.0, (across.min() + across.max()) / 2, 0.0])
            if np.ptp(across) > gap + 0.03:
                # More than the pads can be apart: they hold one wall of it, the nearest to the middle.
                near = across[np.abs(across) < gap / 2 + self.config.held_box[1] + 0.012]
                shift[1] = near.mean() if len(near) else 0.0
            best = int(between.sum()), name, PointCloud(local.points - shift, local.normals)
        return None if best is None else best[1:]

    def _forget(self, name: str) -> None:
        self.seen.pop(name, None)
        self.whole.pop(name, None)

    def _update_seen(self, labelled: Sequence[LabelledView]) -> None:
        """Add what is seen now, and drop what has moved; the held object is not looked at."""
        camera = self.config.camera
        now = {name: self._cleaned(name, labelled) for name in dict.fromkeys(n for v in labelled for n in v.names if n)}
        for name in list(self.seen):
            self._recheck(name, now.get(name, clouds.NO_POINTS), labelled)
        for name, cloud in now.items():
            if self.held is not None and name == self.held[0]:
                continue
            old = self.seen.get(name, clouds.NO_POINTS)
            if len(cloud.points) >= camera.least_points or len(old.points):
                both = clouds.fused(old, cloud, 0.75 * camera.voxel)
                most = camera.most_fixture_points if self._is_fixed(both) else camera.most_points
                self.seen[name] = clouds.thinned(both, camera.voxel, most)

    def _recheck(self, name: str, now: PointCloud, labelled: Sequence[LabelledView]) -> None:
        """Drop the remembered points of an object that cameras see to be gone; all of them if it has moved."""
        camera, points = self.config.camera, self.seen[name].points
        gone = clouds.seen_through(points, [view.view for view in labelled], camera.tolerance)
        shown = np.zeros(len(points), bool)
        for view in labelled:
            visible = view.view.shows(points, camera.tolerance)
            shown |= visible
            gone |= visible & ~self._is_shown(points, name, view)
        away = KDTree(now.points).query(points)[0] if len(now.points) else np.full(len(points), np.inf)
        gone |= shown & (away > 1.5 * camera.tolerance)
        if gone.sum() > camera.moved * max(int((gone | shown).sum()), 1):
            self._forget(name)
        else:
            self.seen[name] = clouds.kept(self.seen[name], ~gone)

    def _is_shown(self, points: np.ndarray, name: str, view: LabelledView) -> np.ndarray:
        """Whether a camera shows an object, or the robot, within two pixels of each point."""
        ids = [i for i, known in enumerate(view.names) if known is None or known == name]
        mask = binary_dilation(np.isin(view.labels, ids), iterations=2)
        row, column, _, _ = view.view.project(points)
        return mask[row, column]

    def _cleaned(self, name: str, labelled: Sequence[LabelledView]) -> PointCloud:
        """What all cameras show of an object now, without outliers and without the table at its edges."""
        camera = self.config.camera
        assert self.table is not None
        cloud = self.inside(clouds.joined([view.of(name) for view in labelled]))
        on_table = (cloud.points[:, 2] < self.table + camera.on_table) & (cloud.normals[:, 2] > 0.9)
        cloud = clouds.thinned(clouds.kept(cloud, ~on_table), camera.voxel)
        return clouds.without_outliers(cloud, camera.cluster, 0.1)

    def _complete(self, views: Sequence[DepthView], scenery: PointCloud) -> None:
        """Complete what is not fixed; what is fixed stays as it is seen."""
        camera = self.config.camera
        assert self.table is not None
        for name, cloud in self.seen.items():
            if self._is_fixed(cloud):
                self.whole[name] = cloud
                continue
            others = [other for known, other in self.seen.items() if known != name]
            bottom = clouds.support_under(cloud.points, clouds.joined([*others, scenery]), self.table)
            whole = clouds.completed(cloud, bottom, views, camera.tolerance)
            self.whole[name] = clouds.thinned(whole, camera.voxel, camera.most_points)

    def _is_fixed(self, cloud: PointCloud) -> bool:
        return bool(np.ptp(cloud.points[:, :2], axis=0).max() > self.config.camera.fixed)

    # -- the snapshot --------------------------------------------------------------------------------------------------

    def bounds(self) -> np.ndarray:
        """Corners of the workspace, [2, 3]; heights are relative until the table is known."""
        corners = np.array(self.config.camera.workspace, float)
        corners[:, :2] += self.base
        corners[:, 2] += self.table or 0.0
        return corners

    def inside(self, cloud: PointCloud) -> PointCloud:
        """The points over the workspace, at any height before the table is known."""
        low, high = self.bounds()
        used = 2 if self.table is None else 3
        low, high = low - [0.05, 0.05, 0.0], high + [0.05, 0.05, 0.15]
        rows = ((cloud.points > low) & (cloud.points < high))[:, :used].all(axis=1)
        return clouds.kept(cloud, rows)

    def _scenery(self, background: PointCloud) -> PointCloud:
        """What belongs to no object: the table, flat and at one height, and what stands out of it."""
        assert self.table is not None
        cloud = self.inside(background)
        flat = (np.abs(cloud.points[:, 2] - self.table) < 0.01) & (cloud.normals[:, 2] > 0.9)
        table = clouds.thinned(clouds.kept(cloud, flat), _TABLE_VOXEL)
        level = PointCloud(
            np.column_stack([table.points[:, :2], np.full(len(table.points), self.table)]),
            np.tile([0.0, 0.0, 1.0], (len(table.points), 1)),
        )
        rest = clouds.thinned(clouds.kept(cloud, ~flat), _SCENERY_VOXEL)
        return clouds.joined([level, clouds.without_outliers(rest, 2 * _SCENERY_VOXEL, 0.05)])

    def _grounded(self, scenery: PointCloud) -> PointCloud:
        """Scenery of which the table alone has normals, so that nothing else is taken for the ground."""
        off = np.abs(scenery.points[:, 2:] - (self.table or 0.0)) > 1e-9
        return PointCloud(scenery.points, np.where(off, 0.0, scenery.normals))

    def _snapshot(self, scenery: PointCloud, robot: Proprioception) -> ObjectsSnapshot:
        movable = tuple(name for name, cloud in self.whole.items() if not self._is_fixed(cloud))
        names = (*movable, *(name for name in self.whole if name not in movable))
        objects = {name: self.whole[name] for name in names}
        # A snapshot is frozen by who reads it: what is remembered must stay writable.
        copied = {name: PointCloud(cloud.points.copy(), cloud.normals.copy()) for name, cloud in objects.items()}
        parts = {}
        for name, cloud in copied.items():
            parts.update(parts_of(name, cloud, fixed=name not in movable, table=self.table or 0.0, config=self.config))
        return ObjectsSnapshot(
            names=names,
            objects=copied,
            poses={name: _pose(cloud) for name, cloud in copied.items()},
            regions={},
            goal=(),
            scene=clouds.joined([*copied.values(), self._grounded(scenery)]),
            ee_pose=robot.ee_pose.copy(),
            gripper=robot.gripper.copy(),
            workspace=self.bounds(),
            movable=movable,
            parts=parts,
        )


def table_height(cloud: PointCloud) -> float:
    """Height of the level surface that takes up most of what is seen, metres.

    Args:
        cloud: everything seen over the workspace.

    Raises:
        NotSeen: there is no level surface.
    """
    level = cloud.points[cloud.normals[:, 2] > 0.95]
    if len(level) < 50:
        raise NotSeen("no table is seen: too few pixels over the workspace show a level surface")
    cells = np.unique(np.floor(level / [0.01, 0.01, 0.005]).astype(int), axis=0)
    heights, counts = np.unique(cells[:, 2], return_counts=True)
    best = 0.005 * (heights[counts.argmax()] + 0.5)
    return float(np.median(level[np.abs(level[:, 2] - best) < 0.005, 2]))


def _pose(cloud: PointCloud) -> np.ndarray:
    return np.array([*clouds.middle_of(cloud.points), float(cloud.points[:, 2].min()), 1.0, 0.0, 0.0, 0.0])


def _moved(cloud: PointCloud, rotation: np.ndarray, pos: np.ndarray) -> PointCloud:
    return PointCloud(cloud.points @ rotation.T + pos, cloud.normals @ rotation.T)
