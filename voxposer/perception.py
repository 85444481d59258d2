"""What programs can see: every nameable thing of one frozen snapshot, as voxels, with how to grasp it and where to put.

One slot's :class:`~vecenv.contract.ObjectsSnapshot` and the :class:`Hand` come in; :meth:`Perception.detect` gives
observations by name. Names are the task's things, their parts (``vecenv.libero.scene.parts`` says how they are named),
and a few aliases for the hand, the table and whatever is held. Nothing else of the task is read: no goal, no regions of
the goal, no object of interest. All of it is geometry on true surface points; grasps and places are worked out when a
program asks for them, once a snapshot. A snapshot is frozen: its arrays refuse to be written.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from vecenv.contract import ObjectsSnapshot, Part, PointCloud, RegionBox
from vecenv.errors import NotFound
from vecenv.manipulation.grasps import Grasps, Gripper, clearance, room_around
from vecenv.manipulation.placing import Target, choose_grasp, put_down
from vecenv.manipulation.world import Margins, World, down_facing, matrix, pinching, spun, tilted, upright, yaw
from voxposer.language.lmp import Observation
from voxposer.planning import maps

MAP_SIZE = 100

EE_ALIASES = frozenset({"ee", "endeffector", "end_effector", "end effector", "gripper", "hand", "robot hand"})
TABLE_ALIASES = frozenset(
    {"table", "desk", "floor", "workstation", "work_station", "work station", "workspace", "work_space", "work space"}
)
HELD_ALIASES = frozenset({"held object", "held_object", "object in hand", "held thing"})


class PerceptionError(NotFound):
    """There is no such thing here, or it does not offer what was asked of it."""


@dataclass(frozen=True, kw_only=True)
class PerceptionConfig:
    """How things are seen. Metres unless noted.

    Attributes:
        margins: of picking and placing.
        held_box: half extents of the space between the pads, along the hand's x, y (closing) and z: what has points in
            it while the fingers are closed around something is held. The closing half extent is what is left of a pad.
        closed_gap: fingers that were told to close and stay further apart than this hold something.
        bar_depth: how deep the bar of a handle is at most.
        tilts: of the hand from the vertical, tried at a handle, steepest first, radians.
        push_tilts: of the hand from the vertical while it pushes a part shut, best first, radians.
        less_tilt: room that each step down that list must gain, metres.
        push_start: how far before a part such a push begins.
        wrist_back: how far behind the grip site the wrist is.
        nearest: a wrist closer than this to the robot's base, horizontally, is out of reach.
        handle_room: room that suffices around the hand at a handle.
        table_margin: share of the workspace left out at each side of the table.
        above: how far over a thing the hand goes when it has nothing to put down.
        edge: how far inside a place the middle of what is put there stays.
        home_reach: how far the hand is before the robot's base when an episode begins.
    """

    margins: Margins = field(default_factory=lambda: Margins(gripper=Gripper(wrist=0.14), grasp_tilts=(0.3, 0.6)))
    held_box: tuple[float, float, float] = (0.020, 0.006, 0.022)
    closed_gap: float = 0.0015
    bar_depth: float = 0.017
    tilts: tuple[float, ...] = (np.pi / 4, np.pi / 3, 1.4)
    push_tilts: tuple[float, ...] = (np.pi / 4, 0.6, 0.4, 0.2, 0.0)
    less_tilt: float = 0.01
    push_start: float = 0.08
    wrist_back: float = 0.2
    nearest: float = 0.30
    handle_room: float = 0.0
    table_margin: float = 0.1
    above: float = 0.10
    edge: float = 0.03
    home_reach: float = 0.45


@dataclass(frozen=True)
class Hand:
    """The hand of one slot.

    Attributes:
        pose: of the grip site, xyz + wxyz, [7].
        home: its pose when the episode began, [7].
        closed: the last command closed it.
    """

    pose: np.ndarray
    home: np.ndarray
    closed: bool = False


@dataclass(frozen=True)
class Grid:
    """Voxels over a workspace: ``lo`` and ``hi`` [3] in metres are the centres of the first and the last."""

    lo: np.ndarray
    hi: np.ndarray
    size: int = MAP_SIZE

    @property
    def resolution(self) -> np.ndarray:
        """Edge of a voxel, metres, [3]."""
        return (self.hi - self.lo) / self.size

    def voxel(self, points: np.ndarray) -> np.ndarray:
        """World positions [..., 3] to the nearest voxels, int [..., 3]; outside ones to the border."""
        return maps.to_voxel(np.asarray(points), self.lo, self.hi, self.size).astype(int)

    def world(self, voxels: np.ndarray) -> np.ndarray:
        """Middles of voxels [..., 3], metres; voxels may be fractions."""
        return maps.to_world(np.asarray(voxels), self.lo, self.hi, self.size).astype(float)

    def occupancy(self, points: np.ndarray) -> np.ndarray:
        """Voxels that hold one of the points, bool [N, N, N]; points outside go to the border, as upstream's do."""
        taken = np.zeros((self.size,) * 3, bool)
        taken[tuple(self.voxel(points).T)] = True
        return taken


class Detected(Observation):
    """An observation whose costly values are worked out when they are read.

    Args:
        values: what is known.
        later: what is worked out on reading, by name.
    """

    def __init__(self, values: Mapping[str, Any], later: Mapping[str, Callable[[], Any]]) -> None:
        super().__init__({**values, **dict.fromkeys(later)})
        self._later = dict(later)

    def __getitem__(self, name: str, /) -> Any:
        return self._later[name]() if name in self._later else super().__getitem__(name)


@dataclass(frozen=True)
class Grip:
    """A pose of the hand: ``pos`` [3] and ``rotation`` [3, 3]."""

    pos: np.ndarray
    rotation: np.ndarray


class Perception:
    """One snapshot, seen by name.

    Args:
        snapshot: ground truth of one slot; its arrays are made read-only.
        hand: the hand.
        config: how things are seen.
        failed: by name, positions of grasps that did not hold, relative to the thing's origin.

    Attributes:
        snapshot: the snapshot.
        grid: its voxels.
        base: where the robot stands, [3], its height not known.
        world: the snapshot as grasping and placing see it.
        exact: voxel -> the world position [3] that it was rounded from, for every grasp and place handed out.
        targets: voxel -> name of the thing that a grasp handed out there is meant for.
        closed: whether the hand counts as closed where it counts as being.
    """

    def __init__(
        self,
        snapshot: ObjectsSnapshot,
        hand: Hand,
        config: PerceptionConfig = PerceptionConfig(),
        failed: Mapping[str, Sequence[np.ndarray]] | None = None,
    ) -> None:
        freeze(snapshot)
        self.snapshot, self.hand, self.config = snapshot, hand, config
        self.grid = Grid(snapshot.workspace[0], snapshot.workspace[1])
        self.base = np.array([hand.home[0] - config.home_reach, hand.home[1], 0.0])
        self.world = World(snapshot, config.margins, self.base[:2])
        self.exact: dict[tuple[int, int, int], np.ndarray] = {}
        self.targets: dict[tuple[int, int, int], str] = {}
        self._failed = failed or {}
        self._grasps: dict[str, Grip] = {}
        self._places: dict[str, Grip] = {}
        self._moved = Grip(snapshot.ee_pose[:3], matrix(snapshot.ee_pose[3:]))
        self.closed = hand.closed

    # -- names ---------------------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Everything a program can name: things, then their parts."""
        return (*self.snapshot.names, *self.snapshot.parts)

    def detect(self, name: str) -> Detected:
        """Observation of what is called ``name``.

        Raises:
            PerceptionError: nothing is called that; the message says what is.
        """
        asked = name.strip()
        if asked.lower() in EE_ALIASES:
            return self._hand(asked)
        if asked.lower() in TABLE_ALIASES:
            return self._table(asked)
        if asked.lower() in HELD_ALIASES:
            return self._thing(self.held, self._carried(self.held)) if self.held else self._hand(asked)
        if asked in self.snapshot.parts:
            return self._part(asked, self.snapshot.parts[asked])
        if asked in self.snapshot.objects:
            return self._thing(asked, self._carried(asked))
        close = difflib.get_close_matches(asked, self.names, n=3) or self.names
        raise PerceptionError(f"nothing here is called {asked!r}; did you mean {', '.join(close)}?")

    def position_of(self, voxel: np.ndarray) -> np.ndarray:
        """World position [3] of a voxel: exactly where a grasp or place was rounded to it, else the voxel's middle."""
        x, y, z = (int(index) for index in np.round(voxel))
        exact = self.exact.get((x, y, z))
        return self.grid.world(np.asarray(voxel)) if exact is None else exact

    # -- the hand ------------------------------------------------------------------------------------------------------

    @property
    def ee(self) -> Grip:
        """Where the hand counts as being: where it is, or at the end of what is planned already."""
        return self._moved

    def move_hand(self, pos: np.ndarray, rotation: np.ndarray, *, closed: bool | None = None) -> None:
        """Let the hand, and what it holds, count as being elsewhere: at the end of a plan not yet followed."""
        self._moved = Grip(np.array(pos, float), np.array(rotation, float))
        self.closed = self.closed if closed is None else closed

    @cached_property
    def held(self) -> str:
        """The movable thing in the hand, "" for none."""
        return next(iter(self._between_pads(self.snapshot.movable)), "")

    @cached_property
    def attached(self) -> str:
        """The fixture that the closed hand holds a part of, "" for none."""
        fixtures = [name for name in self.snapshot.names if name not in self.snapshot.movable]
        return "" if self.held else next(iter(self._between_pads(fixtures)), "")

    def _between_pads(self, names: Sequence[str]) -> list[str]:
        """Those of the things that have points between the closed pads, most points first."""
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

    def _hand(self, name: str) -> Detected:
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
        return Detected(values, later)

    # -- things --------------------------------------------------------------------------------------------------------

    def _carried(self, name: str) -> PointCloud:
        """Surface of a thing; what is held moves along with the hand."""
        cloud = self.snapshot.objects[name]
        if name != self.held:
            return cloud
        turn = self.ee.rotation @ matrix(self.snapshot.ee_pose[3:]).T
        return PointCloud((cloud.points - self.world.hand) @ turn.T + self.ee.pos, cloud.normals @ turn.T)

    def _table(self, name: str) -> Detected:
        lo, hi = self.grid.lo, self.grid.hi
        inset = self.config.table_margin * (hi - lo)
        centre = (lo + hi) / 2
        ground = self.world.ground(centre[:2])
        corners = np.array([[*(lo + inset)[:2], ground], [*(hi - inset)[:2], ground]])
        cloud = PointCloud(self.world.scenery, np.tile([0.0, 0.0, 1.0], (len(self.world.scenery), 1)))
        target = Target(centre[None, :2], np.zeros(1), floor=ground)
        observed = self._observed(name, cloud, lambda: Grip(corners.mean(axis=0), upright(self.ee.rotation)), target)
        values = {
            "position": self.grid.voxel(corners.mean(axis=0)),
            "aabb": self.grid.voxel(corners),
            "normal": np.array([0.0, 0.0, 1.0]),
            "_position_world": corners.mean(axis=0),
        }
        return _changed(observed, values)

    def _thing(self, name: str, cloud: PointCloud) -> Detected:
        """An object or fixture."""
        target = self._target(name)
        return self._observed(name, cloud, lambda: self._grasp_thing(name), target)

    def _part(self, name: str, part: Part) -> Detected:
        observed = self._observed(name, part.cloud, lambda: self._grasp_part(name, part), self._part_target(part))
        values: dict[str, Any] = {"normal": _outward(part, self.world)}
        if part.joint is not None and part.kind != "knob":
            values["push_quat"] = quaternion(self._pushing(part))
        if part.joint is not None:
            values |= {"axis": opening_direction(part), "is_open": part.joint.opened > 0.5 * part.joint.travel}
        return _changed(observed, values)

    def _pushing(self, part: Part) -> np.ndarray:
        """The hand [3, 3] that pushes a part shut: leaning into the push as far as the robot and things leave room."""
        out = opening_direction(part)
        start = part.cloud.points.mean(axis=0) + self.config.push_start * out
        obstacles = np.concatenate([self.world.others(), self.world.walls])
        obstacles = obstacles[np.linalg.norm(obstacles - start, axis=1) < 0.4]
        hands = [tilted(-out, tilt, self.world.hand_rotation) for tilt in self.config.push_tilts]
        wrists = [start - self.config.wrist_back * hand[:, 2] - self.base for hand in hands]
        lacks = [max(self.config.nearest - float(np.linalg.norm(wrist[:2])), 0.0) for wrist in wrists]
        rooms = [room_around(start, hand, obstacles, self.config.margins.gripper) for hand in hands]
        costs = [lack + max(-room, 0.0) for lack, room in zip(lacks, rooms, strict=True)]
        return hands[int(np.argmin(costs + self.config.less_tilt * np.arange(len(hands))))]

    def _observed(self, name: str, cloud: PointCloud, grasp: Callable[[], Grip], target: Target | None) -> Detected:
        points = cloud.points
        held = name == self.held
        bottom = np.array([*(points.min(axis=0) + points.max(axis=0))[:2] / 2, points[:, 2].min()])
        values = {
            "name": name,
            "position": self.grid.voxel(points.mean(axis=0)),
            "aabb": self.grid.voxel(np.stack([points.min(axis=0), points.max(axis=0)])),
            "normal": _unit(cloud.normals.mean(axis=0)),
            "axis": None,
            "is_open": None,
            "held": held,
            "hand_offset": self.grid.voxel(self.ee.pos) - self.grid.voxel(bottom) if held else np.zeros(3, int),
            "_position_world": points.mean(axis=0),
            "_point_cloud_world": points,
        }
        later: dict[str, Callable[[], Any]] = {
            "occupancy_map": lambda: self.grid.occupancy(points).astype(float),
            "grasp_position": lambda: self._aim(self._once(self._grasps, name, grasp), name),
            "grasp_quat": lambda: quaternion(self._once(self._grasps, name, grasp).rotation),
            "place_position": lambda: self._aim(self._place(name, points, target)),
            "place_quat": lambda: quaternion(self._place(name, points, target).rotation),
        }
        return Detected(values, later)

    def _once(self, known: dict[str, Grip], name: str, find: Callable[[], Grip]) -> Grip:
        if name not in known:
            known[name] = find()
        return known[name]

    def _aim(self, grip: Grip, grasped: str = "") -> np.ndarray:
        """The voxel of a hand position, which is remembered exactly."""
        voxel = self.grid.voxel(grip.pos)
        key = (int(voxel[0]), int(voxel[1]), int(voxel[2]))
        self.exact[key] = grip.pos
        if grasped:
            self.targets[key] = grasped
        return voxel

    # -- grasping ------------------------------------------------------------------------------------------------------

    def _grasp_thing(self, name: str) -> Grip:
        if name not in self.snapshot.movable:
            raise PerceptionError(
                f"{name} is fixed; grasp one of its parts: {', '.join(self._parts_of(name)) or 'none'}"
            )
        found = choose_grasp(self.world, name, self._failed.get(name, ()), narrow=False)
        if found is None:
            raise PerceptionError(f"{name} offers nothing to hold: every face is too wide, too steep or out of reach")
        return Grip(found.pos, found.rotation)

    def _parts_of(self, name: str) -> list[str]:
        return [part for part, spec in self.snapshot.parts.items() if spec.parent == name]

    def _grasp_part(self, name: str, part: Part) -> Grip:
        if part.kind == "knob":
            return self._grasp_knob(part)
        if part.kind == "handle":
            return self._grasp_handle(part)
        if part.joint is not None:
            joined = {
                key: p for key, p in self.snapshot.parts.items() if p.parent == part.parent and p.kind == "handle"
            }
            handle = min(joined.values(), key=lambda p: _apart(p, part), default=None)
            if handle is not None:
                return self._grasp_handle(handle)
        raise PerceptionError(f"{name} is a place, not something to hold")

    def _grasp_knob(self, part: Part) -> Grip:
        """The ridge of a knob, from above."""
        points = part.cloud.points
        ridge = points[points[:, 2] > points[:, 2].max() - 0.02]
        centre = (ridge.min(axis=0) + ridge.max(axis=0)) / 2
        _, vectors = np.linalg.eigh((ridge - centre)[:, :2].T @ (ridge - centre)[:, :2])
        across = np.append(vectors[:, 0], 0.0)
        rotation = _least_turned(down_facing(across[None])[0])
        gripper = self.config.margins.gripper
        return Grip(np.append(centre[:2], points[:, 2].max() - 0.6 * gripper.palm + 0.004), rotation)

    def _grasp_handle(self, part: Part) -> Grip:
        """The bar of a handle: pinched across its length by a hand that comes from outside, tilted as room allows."""
        bar, length = self._bar(part)
        options = [
            pinching(-opening_direction(part), tilt, length, self.world.hand_rotation) for tilt in self.config.tilts
        ]
        rooms = [self._room(bar, rotation, part) for rotation in options]
        fits = [rotation for rotation, room in zip(options, rooms, strict=True) if room > self.config.handle_room]
        return Grip(bar, fits[0] if fits else options[int(np.argmax(rooms))])

    def _bar(self, part: Part) -> tuple[np.ndarray, np.ndarray]:
        """Middle of a handle's bar [3] and the direction of its length, [3]."""
        out = opening_direction(part)
        points = part.cloud.points
        front = points[points @ out > (points @ out).max() - self.config.bar_depth]
        middle = (front.min(axis=0) + front.max(axis=0)) / 2
        spread = front - front.mean(axis=0)
        _, vectors = np.linalg.eigh(spread.T @ spread)
        return middle, vectors[:, 2]

    def _room(self, pos: np.ndarray, rotation: np.ndarray, part: Part) -> float:
        """Room around an open hand that comes to a handle along its own axis, other parts and the table considered."""
        own = part.cloud.points
        others = np.concatenate([self.snapshot.scene.points, *self._other_parts(part)])
        others = others[np.linalg.norm(others - pos, axis=1) < self.config.margins.neighbours]
        away = np.linalg.norm(others[:, None] - own[None, ::8], axis=2).min(axis=1) if len(others) else np.zeros(0)
        local = (others[away > 0.012] - pos) @ rotation @ down_facing(np.array([[0.0, 1.0, 0.0]]))[0].T
        here = Grasps(np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]]), np.zeros(1), np.zeros(1))
        return float(clearance(here, local, self.config.margins.gripper)[0])

    def _other_parts(self, part: Part) -> list[np.ndarray]:
        return [p.cloud.points for p in self.snapshot.parts.values() if p is not part and p.kind != "space"]

    # -- placing -------------------------------------------------------------------------------------------------------

    def _place(self, name: str, points: np.ndarray, target: Target | None) -> Grip:
        return self._once(self._places, name, lambda: self._find_place(points, target))

    def _find_place(self, points: np.ndarray, target: Target | None) -> Grip:
        rotation = upright(self.world.hand_rotation)
        if target is None or not self.held:
            top = np.append((points.min(axis=0) + points.max(axis=0))[:2] / 2, points[:, 2].max() + self.config.above)
            return Grip(top, rotation)
        return Grip(*put_down(self.world, self.held, target))

    def _target(self, name: str) -> Target | None:
        """Where things go that are put on or in a whole thing: into its only space, onto its only top, onto itself."""
        parts = [self.snapshot.parts[part] for part in self._parts_of(name)]
        for kind in ("space", "top"):
            places = [part for part in parts if part.kind == kind]
            if len(places) == 1:
                return self._part_target(places[0])
        xy = self.snapshot.poses[name][:2]
        return Target(xy[None], np.zeros(1), floor=self.world.ground(xy))

    def _part_target(self, part: Part) -> Target | None:
        if part.box is None or part.kind == "handle":
            return None
        half = extent(part.box)
        if part.kind == "top":
            xy, cost = grid_around(part.box.pos[:2], np.maximum(half[:2] - self.config.edge, 0.0))
            return Target(xy, cost, floor=part.box.pos[2] + half[2])
        xy, cost = grid_around(part.box.pos[:2], np.maximum(half[:2] - self.config.edge, 0.0))
        floor = max(part.box.pos[2] - half[2], self.world.ground(part.box.pos[:2]))
        target = Target(xy, cost, floor=floor, centre=part.box.pos[:2], half=half[:2])
        out = _way_out(part, self.world) if part.kind == "space" else np.array([0.0, 0.0, 1.0])
        if out[2] > 0.5:
            return target
        low, high = _cavity(part, self.world)
        middle = (low + high)[:2] / 2
        return Target(
            middle[None], np.zeros(1), low[2], centre=middle, half=(high - low)[:2] / 2, entry=out, roof=high[2]
        )


def freeze(snapshot: ObjectsSnapshot) -> None:
    """Make every array of a snapshot read-only."""
    for value in _arrays(snapshot):
        value.flags.writeable = False


def _arrays(value: Any) -> list[np.ndarray]:
    """Every array in nested dataclasses and mappings."""
    if isinstance(value, np.ndarray):
        return [value]
    if dataclasses.is_dataclass(value):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return [array for item in value.values() for array in _arrays(item)] if isinstance(value, Mapping) else []


def extent(region: RegionBox) -> np.ndarray:
    """Half extents of a region along the world's axes, [3]."""
    return np.abs(region.mat) @ region.half_extents


def grid_around(centre: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places around a centre [M, 2], the centre first, and their cost [M]: the distance in units of 2 cm."""
    ticks = np.linspace(-1, 1, 5)
    offsets = np.stack(np.meshgrid(ticks * reach[0], ticks * reach[1]), axis=-1).reshape(-1, 2)
    distance = np.linalg.norm(offsets, axis=1)
    order = np.argsort(distance, kind="stable")
    return centre + offsets[order], distance[order] / 0.02


def opening_direction(part: Part) -> np.ndarray:
    """Where a part goes when it opens, unit vector [3]: along its slide, or along the circle around its hinge.

    A part that turns about itself (a knob) gives the axis about which it turns counterclockwise to switch on.
    """
    assert part.joint is not None
    if part.joint.kind == "slide" or part.kind == "knob":
        return part.joint.axis.copy()
    middle = (part.cloud.points.min(axis=0) + part.cloud.points.max(axis=0)) / 2
    return _unit(np.cross(part.joint.axis, middle - part.joint.anchor))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion wxyz [4] of a rotation matrix [3, 3], w not negative."""
    m = np.asarray(rotation, float)
    four = 1 + np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) @ np.diag(m)
    skew = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    largest = int(four.argmax())
    q = np.empty(4)
    q[largest] = four[largest]
    if largest == 0:
        q[1:] = skew
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0], q[1 + j], q[1 + k] = skew[i], m[j, i] + m[i, j], m[k, i] + m[i, k]
    q /= np.linalg.norm(q)
    return -q if q[0] < 0 else q


def _outward(part: Part, world: World) -> np.ndarray:
    """The way out of a part, [3]: up for tops and knobs, the opening direction for handles, drawers and doors."""
    if part.joint is not None and part.kind != "knob":
        return opening_direction(part)
    if part.kind == "space" and part.box is not None:
        return _way_out(part, world)
    return np.array([0.0, 0.0, 1.0])


def _way_out(part: Part, world: World) -> np.ndarray:
    """Up out of a space, or if something roofs it, to the side that has the least surface before it.

    Where there is a door, it is its side. Of sides alike, the one that faces the robot is taken.
    """
    assert part.box is not None
    doors = [p for p in world.snapshot.parts.values() if p.parent == part.parent and p.kind == "door"]
    if doors:
        shut = (_shut(doors[0]).mean(axis=0) - part.box.pos) @ part.box.mat / part.box.half_extents
        axis = int(np.abs(shut).argmax())
        return part.box.mat[:, axis] * np.sign(shut[axis])
    share = _surface_shares(part, world)
    faces = [(axis, sign) for axis in range(3) for sign in (1.0, -1.0)]
    ways = {face: part.box.mat[:, face[0]] * face[1] for face in faces}
    before = {face: _points_before(share, *face) for face in faces}
    upward = max(faces, key=lambda face: ways[face][2])
    if before[upward] < max(3, 0.008 * len(share)):
        return ways[upward]
    towards = np.zeros(3) if world.base is None else np.append(world.base - part.box.pos[:2], 0.0)
    level = [face for face in faces if abs(ways[face][2]) < 0.5]
    return ways[min(level, key=lambda face: (before[face], -float(ways[face] @ towards)))]


def _shut(part: Part) -> np.ndarray:
    """Points of a door as they are when it is shut, [N, 3]."""
    assert part.joint is not None
    half = -part.joint.opened / 2
    turn = matrix(np.array([np.cos(half), *(np.sin(half) * part.joint.axis)]))
    return (part.cloud.points - part.joint.anchor) @ turn.T + part.joint.anchor


def _surface_shares(part: Part, world: World) -> np.ndarray:
    """Surface of what a space is in, doors apart, in half extents of the space's box from its middle, [N, 3]."""
    assert part.box is not None
    doors = [p.cloud.points for p in world.snapshot.parts.values() if p.parent == part.parent and p.joint is not None]
    points = _apart_from(np.concatenate([world.points(part.parent), part.cloud.points]), doors)
    return (points - part.box.pos) @ part.box.mat / part.box.half_extents


def _cavity(part: Part, world: World) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner [3] of what is free of a space's box, walked from its middle to each side."""
    assert part.box is not None
    share = _surface_shares(part, world)
    free = np.ones((2, 3))
    for axis in range(3):
        beside = (np.abs(np.delete(share, axis, axis=1)) < 0.45).all(axis=1)
        for row, sign in enumerate((-1.0, 1.0)):
            ahead = sign * share[beside, axis]
            free[row, axis] = ahead[ahead > 0.1].min(initial=1.0)
    ends = np.stack([-free[0], free[1]]) * part.box.half_extents @ part.box.mat.T + part.box.pos
    return ends.min(axis=0), ends.max(axis=0)


def _points_before(share: np.ndarray, axis: int, sign: float) -> int:
    """How many points lie towards one face of a box, in the middle of the way; coordinates in half extents."""
    ahead = (share[:, axis] * sign > 0.5) & (share[:, axis] * sign < 2.5)
    return int((ahead & (np.abs(np.delete(share, axis, axis=1)) < 0.45).all(axis=1)).sum())


def _apart_from(points: np.ndarray, clouds: Sequence[np.ndarray], distance: float = 0.02) -> np.ndarray:
    """The points that are farther than a distance from every cloud."""
    for cloud in clouds:
        points = points[np.linalg.norm(points[:, None] - cloud[None, ::2], axis=2).min(axis=1) > distance]
    return points


def _least_turned(rotation: np.ndarray) -> np.ndarray:
    """Of the two hands that close along the same line, the one turned less from home."""
    other = spun(rotation, np.pi)
    return min((rotation, other), key=lambda option: abs(float(yaw(option))))


def _apart(one: Part, other: Part) -> float:
    return float(np.linalg.norm(one.cloud.points.mean(axis=0) - other.cloud.points.mean(axis=0)))


def _changed(observed: Detected, values: Mapping[str, Any]) -> Detected:
    known = {key: observed[key] for key in observed if key not in observed._later}
    return Detected({**known, **values}, observed._later)


def _unit(vector: np.ndarray) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-6 else np.zeros(3)
