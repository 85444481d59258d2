"""Where fixtures stand: stored init states don't say, so it is an input of every slot.

LIBERO draws each fixture's x, y and yaw from its BDDL region at every reset, from NumPy's global generator. Here the
poses are explicit: the region's centre, a draw that depends only on (seed, suite, task, episode), what upstream draws
in an evaluation script's loop (``vecenv.libero.tasks.resets``), or given by the user.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vecenv.errors import InvalidInput
from vecenv.libero.scene.bddl import Problem, Region
from vecenv.libero.scene.scene import Entity, Scene
from vecenv.libero.tasks import resets
from vecenv.protocols import ResetLoop
from vecenv.util import inputs

MODES = ("center", "sampled", "upstream")


class FixtureError(InvalidInput):
    """A fixture pose cannot be used; the message names the fixture and what would be right."""


@dataclass(frozen=True, kw_only=True)
class FixturePlacement:
    """The region a fixture is placed in.

    Attributes:
        body: id of the fixture's root body.
        ranges: rectangles (x0, y0, x1, y1) in the workspace's frame, metres.
        yaw: bounds of the rotation about z, radians.
        origin: world position of the workspace's frame with the height the fixture's root body gets, metres, [3].
    """

    body: int
    ranges: tuple[tuple[float, float, float, float], ...]
    yaw: tuple[float, float]
    origin: tuple[float, float, float]

    def pose(self, u: np.ndarray, rectangle: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """World position [3] and quaternion wxyz [4] for (x, y, yaw) fractions ``u`` in [0, 1] of a rectangle."""
        x0, y0, x1, y1 = self.ranges[rectangle]
        yaw = min(self.yaw) + u[2] * (max(self.yaw) - min(self.yaw))
        pos = np.array(self.origin) + np.array([x0 + u[0] * (x1 - x0), y0 + u[1] * (y1 - y0), 0.0])
        return pos, np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def placements(problem: Problem, scene: Scene) -> dict[str, FixturePlacement]:
    """The fixtures that a task's ``:init`` places on the workspace, by name; the others stay where their file says.

    Raises:
        FixtureError: a region that a fixture is placed in gives no rectangle.
    """
    regions = {region.name: region for region in problem.regions}
    found: dict[str, FixturePlacement] = {}
    for predicate in problem.init:
        if predicate.name != "on" or predicate.args[0] not in scene.entities or predicate.args[1] not in regions:
            continue
        entity, region = scene.entities[predicate.args[0]], regions[predicate.args[1]]
        if entity.fixture and region.target not in scene.entities:
            found[entity.name] = _placement(entity, region, scene)
    return found


def _placement(entity: Entity, region: Region, scene: Scene) -> FixturePlacement:
    if not region.ranges:
        raise FixtureError(f"{entity.name} is placed in region {region.name!r}, which gives no rectangle (:ranges)")
    x, y, z = scene.arena.workspace_offset
    return FixturePlacement(
        body=scene.model.body(entity.root_body).id,
        ranges=region.ranges,
        yaw=region.yaw,
        origin=(x, y, scene.arena.fixture_z + z - entity.bottom_z),
    )


def poses(
    problem: Problem,
    scene: Scene,
    fixtures: str | Mapping[str, Any],
    *,
    keys: Sequence[tuple[int, str, int, int]],
    slots: Sequence[int],
    loop: ResetLoop | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Root body poses of every fixture in n slots of one task.

    Args:
        problem, scene: the task and its compiled scene.
        fixtures: ``"center"``, ``"sampled"``, ``"upstream"``, or a mapping name -> (pos, quat) with pos [3] or [B, 3]
            in metres and quat wxyz [4] or [B, 4], world frame; fixtures not named stay at their region's centre.
        keys: (seed, suite, task, episode) of each slot, what ``"sampled"`` and ``"upstream"`` depend on.
        slots: index of each slot in the batch, which row of a [B, ...] pose it gets.
        loop: how ``"upstream"`` seeds and resets; the loop of OpenVLA and openpi when not given.

    Returns:
        body ids [F], positions [n, F, 3] in metres, quaternions wxyz [n, F, 4].

    Raises:
        FixtureError: unknown mode or fixture name, or an array that is no pose.
        ResetError, ProtocolError: ``"upstream"`` of what upstream cannot reset, or of a seed it does not take.
    """
    known = placements(problem, scene)
    given = _given(fixtures, scene)
    names = [entity.name for entity in scene.fixtures if entity.name in known or entity.name in given]
    bodies = np.array([scene.model.body(scene.entities[name].root_body).id for name in names], int)
    pos = np.zeros((len(slots), len(names), 3))
    quat = np.zeros((len(slots), len(names), 4))
    drawn = _upstream(problem, scene, keys, loop or ResetLoop()) if fixtures == "upstream" else []
    for column, name in enumerate(names):
        if name in given:
            pos[:, column], quat[:, column] = _rows(name, *given[name], slots)
        elif fixtures == "sampled":
            for row, key in enumerate(keys):
                pos[row, column], quat[row, column] = _sample(known[name], name, key)
        elif fixtures == "upstream":
            for row, placed in enumerate(drawn):
                pos[row, column], quat[row, column] = placed[name]
        else:
            pos[:, column], quat[:, column] = known[name].pose(np.full(3, 0.5))
    return bodies, pos, quat


def _sample(placement: FixturePlacement, name: str, key: tuple[int, str, int, int]) -> tuple[np.ndarray, np.ndarray]:
    seed, suite, task, episode = key
    rng = np.random.default_rng([seed, zlib.crc32(suite.encode()), task, episode, zlib.crc32(name.encode())])
    return placement.pose(rng.uniform(size=3), int(rng.integers(len(placement.ranges))))


def _upstream(
    problem: Problem, scene: Scene, keys: Sequence[tuple[int, str, int, int]], loop: ResetLoop
) -> list[dict[str, resets.Pose]]:
    points = [loop.at(int(seed), int(task), int(episode)) for seed, _, task, episode in keys]
    return resets.placed_at(problem, scene, points)


def _given(fixtures: str | Mapping[str, Any], scene: Scene) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    given = {}
    for name, pose in _mapping(fixtures).items():
        if name not in scene.entities or not scene.entities[name].fixture:
            continue
        given[name] = _pose(name, pose)
    return given


def _pose(name: str, pose: Any) -> tuple[np.ndarray, np.ndarray]:
    right = "(pos [3], quat wxyz [4])"
    try:
        pos, quat = pose
    except (TypeError, ValueError) as error:
        raise FixtureError(f"fixtures[{name!r}]: expected {right}, got {inputs.shown(pose)}") from error
    what = f"fixtures[{name!r}]"
    return inputs.floats(pos, what, right, FixtureError), inputs.floats(quat, what, right, FixtureError)


def _mapping(fixtures: str | Mapping[str, Any]) -> Mapping[str, Any]:
    """The poses that the caller gives; none for a mode."""
    if isinstance(fixtures, Mapping):
        return fixtures
    if fixtures not in MODES:
        modes = ", ".join(map(repr, MODES))
        raise FixtureError(f"fixtures={fixtures!r}: expected {modes} or a mapping name -> (pos, quat)")
    return {}


def check(fixtures: str | Mapping[str, Any], scenes: Sequence[Scene], num_envs: int) -> None:
    """Refuse an unknown mode, a mapping that names a fixture none of the scenes has, and poses that are none.

    Raises:
        FixtureError: it is one.
    """
    known = {entity.name for scene in scenes for entity in scene.fixtures}
    unknown = [name for name in _mapping(fixtures) if name not in known]
    if unknown:
        there = ", ".join(sorted(known)) or "none"
        raise FixtureError(f"fixtures names {inputs.shown(unknown[0])}; these scenes have {there}")
    for name, pose in _mapping(fixtures).items():
        arrays = _pose(name, pose)
        _rows(name, *arrays, range(num_envs))
        for label, array in zip(("pos", "quat"), arrays, strict=True):
            if array.ndim == 2 and len(array) != num_envs:
                raise FixtureError(
                    f"fixtures[{name!r}] {label}: {len(array)} rows for {num_envs} slots; expected one a slot"
                )


def _rows(name: str, pos: np.ndarray, quat: np.ndarray, slots: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    for label, array, width in (("pos", pos, 3), ("quat", quat, 4)):
        if array.shape[-1:] != (width,) or array.ndim > 2 or not np.isfinite(array).all():
            raise FixtureError(
                f"fixtures[{name!r}] {label}: expected finite [{width}] or [B, {width}], got {array.shape}"
            )
        if array.ndim == 2 and len(array) <= max(slots, default=-1):
            raise FixtureError(f"fixtures[{name!r}] {label}: {len(array)} rows, but slot {max(slots)} needs one")
    norm = np.linalg.norm(quat, axis=-1, keepdims=True)
    if (norm < 1e-6).any():
        raise FixtureError(f"fixtures[{name!r}] quat: zero length")
    quat = quat / norm
    index = np.asarray(slots, int)
    return (pos if pos.ndim == 1 else pos[index]), (quat if quat.ndim == 1 else quat[index])
