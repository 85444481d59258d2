"""One frozen snapshot, seen by name: the observations that programs read.

One slot's :class:`~vecenv.observations.ObjectsSnapshot` and its :class:`~voxposer.perception.config.HandState` come in;
:meth:`Perception.detect` gives observations by name. Names are the task's objects, their parts
(``vecenv.libero.scene.parts`` names them), and a few aliases for the hand, the table and the held object. The goal of
the task, its regions and its objects of interest are not read. Grasps and places are computed once per snapshot, when a
program reads them.
"""

from __future__ import annotations

import difflib
import functools
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from vecenv.manipulation.placing import Target
from vecenv.manipulation.world import SceneGeometry, matrix, upright
from vecenv.observations import ObjectsSnapshot, Part, PointCloud
from voxposer.perception.config import HandState, PerceptionConfig
from voxposer.perception.grasping import GraspFinder, HandPose
from voxposer.perception.grid import VoxelGrid
from voxposer.perception.observation import LazyObservation, PerceptionError, freeze
from voxposer.perception.parts import opening_direction, outward_direction
from voxposer.perception.placing import PlaceFinder
from voxposer.quaternions import quaternion, unit

HAND_ALIASES = frozenset({"ee", "endeffector", "end_effector", "end effector", "gripper", "hand", "robot hand"})
TABLE_ALIASES = frozenset(
    {"table", "desk", "floor", "workstation", "work_station", "work station", "workspace", "work_space", "work space"}
)
# Characters of a name that is compared with those there are, or shown.
_COMPARED = 60
HELD_ALIASES = frozenset({"held object", "held_object", "object in hand", "held thing"})


class Perception:
    """One snapshot, seen by name.

    Args:
        snapshot: ground truth of one slot; its arrays are made read-only.
        hand: the hand.
        config: options.
        failed: by object, positions of grasps that did not hold, relative to the object's origin.

    Attributes:
        snapshot: the snapshot.
        grid: voxels over its workspace.
        base: position of the robot's base, [3], with height 0.
        scene: the snapshot as grasping and placing use it.
        exact: voxel -> world position [3] that was rounded to it, for every grasp and place read so far.
        targets: voxel -> name of the object that the grasp read there is for.
        closed: whether the hand is taken to be closed at :attr:`ee`.
        turns: of motions that were planned over configuration-space maps, the waypoint from which the hand has the
            rotation of the goal (``voxposer.mapped``).
    """

    def __init__(
        self,
        snapshot: ObjectsSnapshot,
        hand: HandState,
        config: PerceptionConfig = PerceptionConfig(),  # noqa: B008  (frozen)
        failed: Mapping[str, Sequence[np.ndarray]] | None = None,
    ) -> None:
        freeze(snapshot)
        self.snapshot, self.hand, self.config = snapshot, hand, config
        self.grid = VoxelGrid(snapshot.workspace[0], snapshot.workspace[1], config.map_size)
        self.base = np.array([hand.home[0] - config.home_reach, hand.home[1], 0.0])
        self.scene = SceneGeometry(snapshot, config.margins, self.base[:2])
        self.grasp_finder = GraspFinder(self.scene, config, self.base, failed or {})
        self._place_finder = PlaceFinder(self.scene, config)
        self.exact: dict[tuple[int, int, int], np.ndarray] = {}
        self.targets: dict[tuple[int, int, int], str] = {}
        self._grasps: dict[str, HandPose] = {}
        self._places: dict[str, HandPose] = {}
        self._ee = HandPose(snapshot.ee_pose[:3], matrix(snapshot.ee_pose[3:]))
        self.closed = hand.closed
        self.turns: WeakKeyDictionary[object, int] = WeakKeyDictionary()

    # -- names ---------------------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Every name that programs can use: objects, then their parts."""
        return (*self.snapshot.names, *self.snapshot.parts)

    def detect(self, name: str) -> LazyObservation:
        """Observation of the object, part or alias ``name``.

        Raises:
            PerceptionError: there is no such name; the message lists similar ones.
        """
        asked = name.strip()
        if asked.lower() in HAND_ALIASES:
            return self._observe_hand(asked)
        if asked.lower() in TABLE_ALIASES:
            return self._observe_table(asked)
        if asked.lower() in HELD_ALIASES:
            return self._observe_object(self.held) if self.held else self._observe_hand(asked)
        if asked in self.snapshot.parts:
            return self._observe_part(asked, self.snapshot.parts[asked])
        if asked in self.snapshot.objects:
            return self._observe_object(asked)
        close = difflib.get_close_matches(asked, self.names, n=3) if len(asked) <= _COMPARED else []
        close = close or self.names
        raise PerceptionError(f"nothing here is called {asked[:_COMPARED]!r}; did you mean {', '.join(close)}?")

    def position_of(self, voxel: np.ndarray) -> np.ndarray:
        """World position [3] of a voxel: the exact one of a grasp or place that was rounded to it, else its centre."""
        x, y, z = (int(index) for index in np.round(voxel))
        exact = self.exact.get((x, y, z))
        return self.grid.world(np.asarray(voxel)) if exact is None else exact

    # -- the hand ------------------------------------------------------------------------------------------------------

    @property
    def ee(self) -> HandPose:
        """Pose of the hand that programs see: the present one, or the end of what is already planned."""
        return self._ee

    def move_hand(self, pos: np.ndarray, rotation: np.ndarray, *, closed: bool | None = None) -> None:
        """Let programs see the hand, and what it holds, at the end of a plan that is not executed yet."""
        self._ee = HandPose(np.array(pos, float), np.array(rotation, float))
        self.closed = self.closed if closed is None else closed

    @cached_property
    def held(self) -> str:
        """The movable object in the hand, "" for none."""
        return next(iter(self._between_pads(self.snapshot.movable)), "")

    @cached_property
    def attached(self) -> str:
        """The fixture of which the closed hand holds a part, "" for none."""
        fixtures = [name for name in self.snapshot.names if name not in self.snapshot.movable]
        return "" if self.held else next(iter(self._between_pads(fixtures)), "")

    def _between_pads(self, names: Sequence[str]) -> list[str]:
        """The objects that have points between the closed pads, most points first."""
        gap = float(self.snapshot.gripper[0] - self.snapshot.gripper[1])
        if not self.hand.closed or gap < self.config.closed_gap:
            return []
        along, spare, out = self.config.held_box
        half = np.array([along, gap / 2 + spare, out])
        rotation = matrix(self.snapshot.ee_pose[3:])
        counts = {}
        for name in names:
            clouds = [self.snapshot.objects[name].points]
            clouds += [part.cloud.points for part in self.snapshot.parts.values() if part.parent == name]
            local = (np.concatenate(clouds) - self.snapshot.ee_pose[:3]) @ rotation
            counts[name] = int((np.abs(local) < half).all(axis=1).sum())
        return sorted((name for name in names if counts[name]), key=lambda name: -counts[name])

    # -- observations --------------------------------------------------------------------------------------------------

    def _observe_hand(self, name: str) -> LazyObservation:
        voxel = self.grid.voxel(self.ee.pos)
        values = {
            "name": name,
            "position": voxel,
            "aabb": np.stack([voxel, voxel]),
            "normal": self.ee.rotation[:, 2].copy(),
            "grasp_quat": quaternion(self.ee.rotation),
            "place_quat": quaternion(self.ee.rotation),
            "hand_offset": np.zeros(3, int),
            "axis": None,
            "is_open": not self.hand.closed,
            "held": False,
        }
        later = {"occupancy_map": lambda: self.grid.occupancy(self.ee.pos[None]).astype(float)}
        return LazyObservation(values, later)

    def _observe_table(self, name: str) -> LazyObservation:
        lo, hi = self.grid.lo, self.grid.hi
        inset = self.config.table_margin * (hi - lo)
        centre = (lo + hi) / 2
        ground = self.scene.ground(centre[:2])
        corners = np.array([[*(lo + inset)[:2], ground], [*(hi - inset)[:2], ground]])
        cloud = PointCloud(self.scene.scenery, np.tile([0.0, 0.0, 1.0], (len(self.scene.scenery), 1)))
        target = Target(centre[None, :2], np.zeros(1), floor=ground)
        observed = self._observation(
            name, cloud, lambda: HandPose(corners.mean(axis=0), upright(self.ee.rotation)), target
        )
        return observed.updated(
            {
                "position": self.grid.voxel(corners.mean(axis=0)),
                "aabb": self.grid.voxel(corners),
                "normal": np.array([0.0, 0.0, 1.0]),
                "_position_world": corners.mean(axis=0),
            }
        )

    def _observe_object(self, name: str) -> LazyObservation:
        """An object or fixture."""
        target = self._place_finder.of_object(name)
        return self._observation(name, self._surface(name), lambda: self.grasp_finder.of_object(name), target)

    def _surface(self, name: str) -> PointCloud:
        """Surface of an object; the held one moves along with the hand."""
        cloud = self.snapshot.objects[name]
        if name != self.held:
            return cloud
        turn = self.ee.rotation @ matrix(self.snapshot.ee_pose[3:]).T
        return PointCloud((cloud.points - self.scene.hand) @ turn.T + self.ee.pos, cloud.normals @ turn.T)

    def _observe_part(self, name: str, part: Part) -> LazyObservation:
        target = self._place_finder.of_part(part)
        observed = self._observation(name, part.cloud, lambda: self.grasp_finder.of_part(name, part), target)
        values: dict[str, Any] = {"normal": outward_direction(part, self.scene)}
        if part.joint is not None and part.kind != "knob" and self.config.fields == "geometry":
            values["push_quat"] = quaternion(self.grasp_finder.pushing_rotation(part))
        elif part.joint is not None and part.kind != "knob":
            values["push_quat"] = quaternion(upright(self.ee.rotation))
        if part.joint is not None:
            values |= {"axis": opening_direction(part), "is_open": part.joint.opened > 0.5 * part.joint.travel}
        return observed.updated(values)

    def _observation(
        self, name: str, cloud: PointCloud, grasp: Callable[[], HandPose], target: Target | None
    ) -> LazyObservation:
        points = cloud.points
        held = name == self.held
        bottom = np.array([*(points.min(axis=0) + points.max(axis=0))[:2] / 2, points[:, 2].min()])
        values = {
            "name": name,
            "position": self.grid.voxel(points.mean(axis=0)),
            "aabb": self.grid.voxel(np.stack([points.min(axis=0), points.max(axis=0)])),
            "normal": unit(cloud.normals.mean(axis=0)),
            "axis": None,
            "is_open": None,
            "held": held,
            "hand_offset": self.grid.voxel(self.ee.pos) - self.grid.voxel(bottom) if held else np.zeros(3, int),
            "_position_world": points.mean(axis=0),
            "_point_cloud_world": points,
        }

        if self.config.fields == "centroid":
            grasp, place = self._centroid_fields(points)
        else:
            place = functools.partial(self._place_finder.pose, points, target, self.held)
        corner = functools.partial(self._place_finder.corner, target, self.held)
        whole = functools.partial(_once, self._places, name, place)
        half = functools.partial(self._place_finder.half, points, target, self.held, whole)
        left = functools.partial(_once, self._places, f"left half of {name}", functools.partial(half, -1.0))
        right = functools.partial(_once, self._places, f"right half of {name}", functools.partial(half, 1.0))

        later: dict[str, Callable[[], Any]] = {
            "occupancy_map": lambda: self.grid.occupancy(points).astype(float),
            "grasp_position": lambda: self._remember_voxel(_once(self._grasps, name, grasp), name),
            "grasp_quat": lambda: quaternion(_once(self._grasps, name, grasp).rotation),
            "place_position": lambda: self._remember_voxel(whole()),
            "place_quat": lambda: quaternion(whole().rotation),
            "corner_position": lambda: self._remember_voxel(corner(whole())),
            "left_position": lambda: self._remember_voxel(left()),
            "left_quat": lambda: quaternion(left().rotation),
            "right_position": lambda: self._remember_voxel(right()),
            "right_quat": lambda: quaternion(right().rotation),
        }
        return LazyObservation(values, later)

    def _centroid_fields(self, points: np.ndarray) -> tuple[Callable[[], HandPose], Callable[[], HandPose]]:
        """Grasp and place without geometry: an upright hand at the centroid; its load on the middle of the top.

        Args:
            points: surface of the object or part, [N, 3].
        """
        rotation, hangs = upright(self.ee.rotation), np.zeros(3)
        if self.held:
            load = self._surface(self.held).points
            hangs = self.ee.pos - np.append((load.min(axis=0) + load.max(axis=0))[:2] / 2, load[:, 2].min())
        top = np.append((points.min(axis=0) + points.max(axis=0))[:2] / 2, points[:, 2].max())
        return lambda: HandPose(points.mean(axis=0), rotation), lambda: HandPose(top + hangs, rotation)

    def _remember_voxel(self, pose: HandPose, grasped: str = "") -> np.ndarray:
        """The voxel of a hand position; the exact position is kept for :meth:`position_of`."""
        voxel = self.grid.voxel(pose.pos)
        key = (int(voxel[0]), int(voxel[1]), int(voxel[2]))
        self.exact[key] = pose.pos
        if grasped:
            self.targets[key] = grasped
        return voxel


def _once(known: dict[str, HandPose], name: str, find: Callable[[], HandPose]) -> HandPose:
    if name not in known:
        known[name] = find()
    return known[name]
