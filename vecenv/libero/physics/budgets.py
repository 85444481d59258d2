"""How much contact and constraint memory a scene needs on MJX, measured on native MuJoCo.

In: a scene and start states of its tasks. Out: a ``Budget``: the most contacts and constraint rows that any world had,
times a margin. Settled starts are stepped through two rollouts, one of random actions and one that grasps and presses
objects; raw ones are counted as they are placed and while they settle, for there things may be inside each other. MJX
allocates memory once: contacts of a whole batch (``naconmax``, warp), constraint rows of a world (``njmax``, warp),
contacts of a world (``max_contact_points``, jax) and candidate pairs (``max_geom_pairs``, jax). What does not fit is
dropped, so a world that exceeds its budget is a fault.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import itertools
import json
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import mujoco
import numpy as np

from vecenv.errors import InvalidInput
from vecenv.libero.physics.base import SETTLE_ACTION, SETTLE_TICKS, Group, Start
from vecenv.libero.scene.elements import CONTACT_LIMIT, PAIR_LIMIT
from vecenv.libero.scene.scene import Scene
from vecenv.util import caching, configs, inputs

log = logging.getLogger(__name__)
# Factors on the measured maxima. Two boxes have up to eight published contacts, and the number changes from substep to
# substep while fingers press: 1.3 times the rows were too few for libero_10 task 0 (5 of 10 episodes of pick_place).
MARGINS = {"contacts": 1.5, "rows": 2.0, "pairs": 1.5, "candidates": 1.5, "share": 1.75}
# Control ticks of the two rollouts.
RANDOM_TICKS, GRASPING_TICKS = 60, 80
# Part of the cache key: increased when the measurement changes.
VERSION = 7
_HOLD = 5
_DOWNWARDS = np.array([0, 0, -0.5, 0, 0, 0, 0])
# A grasp: ticks until the hand is above an object, on it, holds it, has dragged it about, and has pressed it down.
_ABOVE, _ON, _HELD, _DRAGGED, _PRESSED = 15, 20, 25, 33, 40
_CLEARANCE = 0.12
# Metres that an action of 1 moves the hand.
_REACH = 0.05


class BudgetError(InvalidInput):
    """A budget that cannot be used; the message names the number."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Memory sizes.

    Attributes:
        contacts: contacts of one world (jax: of each contact dimension).
        rows: constraint rows of one world (warp).
        pairs: pairs of geoms of one type of collision whose bounding spheres overlap, in one world (jax).
        candidates: pairs of geoms whose oriented bounding boxes overlap, in one world; warp keeps them where contacts
            go.
        share: what a world of a large batch adds to the memory that warp's worlds share for contacts and candidates;
            as much as the fullest world by default. Never are all worlds as full as the fullest.
    """

    contacts: int
    rows: int
    pairs: int
    candidates: int
    share: int | None = None

    def __post_init__(self) -> None:
        counts = dict.fromkeys(configs.field_names(type(self)), (1, inputs.MOST_COUNT))
        configs.check(self, BudgetError, ranges=counts)

    def warp_sizes(self, num_worlds: int) -> dict[str, int]:
        """Arguments for ``mjx.make_data(impl="warp")``."""
        fullest = max(self.contacts, self.candidates)
        others = fullest if self.share is None else min(self.share, fullest)
        return {"naconmax": fullest + (num_worlds - 1) * others, "njmax": self.rows}

    def limited(self, model: mujoco.MjModel) -> mujoco.MjModel:
        """A copy of the model with the limits that ``impl="jax"`` reads.

        Raises:
            BudgetError: the model was compiled without the numerics that hold them.
        """
        model = copy.copy(model)
        for name, value in ((CONTACT_LIMIT, self.contacts), (PAIR_LIMIT, self.pairs)):
            index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
            if index < 0:
                raise BudgetError(f"the scene has no custom numeric {name!r}; compile it again")
            model.numeric_data[model.numeric_adr[index]] = value
        return model


def largest(budgets: Sequence[Budget]) -> Budget:
    """Memory that is enough for each of several needs."""
    most = {name: max(getattr(each, name) for each in budgets) for name in MARGINS if name != "share"}
    shares = [each.share for each in budgets if each.share is not None]
    return Budget(**most, share=max(shares) if len(shares) == len(budgets) else None)


def measure(scene: Scene, starts: Start, *, ticks: tuple[int, int] = (RANDOM_TICKS, GRASPING_TICKS)) -> Budget:
    """Measure a scene on native MuJoCo.

    Every settled start is stepped twice: with random actions that tend downwards, and with a hand that goes to one
    object after the other, grasps it, drags it about and presses it down. With upstream's geometry, which fills a box
    with boxes, grasping makes twice as many constraint rows as random actions (libero_object task 0: 503 and 225). The
    most contacts, rows and nearby pairs of any world after any tick are kept.

    Raw starts are stepped while they settle, with an idle arm, and count before the first tick as well: things stand up
    to 4 cm deep in the floor of libero_object, and within that tick they are out of it (task 0: 204 contacts in each of
    its 50 starts, 53 a tick later).

    Args:
        scene: the scene.
        starts: start states with their fixture poses.
        ticks: control ticks of either rollout of settled starts.
    """
    from vecenv.libero.physics.native import NativePhysics

    worlds = len(starts.qpos)
    physics = NativePhysics([scene], np.zeros(worlds, int))
    group = physics.groups[0]
    contacts, rows, pos, mat = (group.bind(name) for name in ("ncon", "nefc", "geom_xpos", "geom_xmat"))
    pairs, seen = _Pairs(scene.model), np.ones(len(MARGINS))

    def present() -> tuple[float, ...]:
        of_one_kind, near = pairs.near(pos, mat)
        share = max(contacts.mean(), near.mean())
        return contacts.max(), rows.max(), of_one_kind, near.max(), share

    for count, actions in _rollouts(scene, group, starts, ticks):
        physics.place(group, np.arange(worlds), starts)
        if not starts.settled:
            seen = np.maximum(seen, present())
        for _ in range(count):
            physics.control_step(np.clip(next(actions), -1, 1), np.ones(worlds, bool))
            seen = np.maximum(seen, present())
    physics.close()
    return Budget(**{name: math.ceil(most * MARGINS[name]) for name, most in zip(MARGINS, seen, strict=True)})


def _rollouts(
    scene: Scene, group: Group, starts: Start, ticks: tuple[int, int]
) -> list[tuple[int, Iterator[np.ndarray]]]:
    """Control ticks and actions [worlds, 7] of what is measured from these starts."""
    worlds = len(starts.qpos)
    if not starts.settled:
        return [(SETTLE_TICKS, itertools.repeat(np.tile(SETTLE_ACTION, (worlds, 1))))]
    return list(zip(ticks, (_random_actions(worlds), _grasping_actions(scene, group)), strict=True))


def _random_actions(worlds: int) -> Iterator[np.ndarray]:
    """Random actions that tend downwards, [worlds, 7]."""
    rng = np.random.default_rng(0)
    while True:
        actions = rng.uniform(-1, 1, (worlds, 7)) + _DOWNWARDS
        yield from itertools.repeat(actions, _HOLD)


def _grasping_actions(scene: Scene, group: Group) -> Iterator[np.ndarray]:
    """Actions of hands that grasp, drag and press one object after the other, [worlds, 7]."""
    rng, worlds = np.random.default_rng(0), len(group.slots)
    bodies = np.array([scene.model.body(entity.root_body).id for entity in scene.objects or scene.fixtures])
    actions, world = np.zeros((worlds, 7)), np.arange(worlds)
    while True:
        chosen, drag = bodies[rng.integers(0, len(bodies), worlds)], rng.uniform(-1, 1, (worlds, 3))
        for tick in range(_PRESSED):
            goal = group.xpos[world, chosen] + [0, 0, _CLEARANCE if tick < _ABOVE else 0]
            actions[:, :3] = (goal - group.site_xpos[:, scene.grip_site]) / _REACH
            if tick >= _HELD:
                actions[:, :3] = drag if tick < _DRAGGED else [0, 0, -1]
            actions[:, 6] = -1 if tick < _ON else 1
            yield actions


def cached(scene: Scene, starts: Start) -> Budget:
    """``measure``, with the result kept in the user's cache folder; the key covers model, starts and measurement."""
    folder = caching.folder("budgets")
    if folder is None:
        return measure(scene, starts)
    path = folder / f"{key_of(scene, starts)}.budget"
    data = caching.unsealed(path)
    if data is not None:
        try:
            return Budget(**json.loads(data))
        except (ValueError, TypeError, RecursionError):
            caching.damaged(path, "not a budget")
    log.info("measuring the contact memory of a scene on native MuJoCo, %d worlds", len(starts.qpos))
    budget = measure(scene, starts)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        caching.write_file(path, caching.sealed(json.dumps(asdict(budget)).encode()))
    return budget


def key_of(scene: Scene, starts: Start) -> str:
    """Names what a budget depends on: model, starts, measurement and the version of MuJoCo."""
    model = scene.model
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    digest = hashlib.sha256(repr((VERSION, RANDOM_TICKS, GRASPING_TICKS, MARGINS, mujoco.__version__)).encode())
    for array in (buffer, starts.qpos, starts.qvel, starts.body_pos, starts.body_quat):
        digest.update(np.ascontiguousarray(array).tobytes())
    if not starts.settled:
        digest.update(repr(("raw", SETTLE_TICKS, SETTLE_ACTION.tolist())).encode())
    return digest.hexdigest()


class _Pairs:
    """The candidate pairs of a model by type of collision, as MJX's broad phases see them."""

    def __init__(self, model: mujoco.MjModel) -> None:
        first, second = np.triu_indices(model.ngeom, 1)
        one, other = model.geom_contype, model.geom_conaffinity
        meets = (one[first] & other[second]) | (one[second] & other[first])
        weld = model.body_weldid[model.geom_bodyid]
        kept = (meets != 0) & (weld[first] != weld[second])
        self._first, self._second = first[kept], second[kept]
        types = np.sort(model.geom_type[np.stack([self._first, self._second])], axis=0)
        endless = types[0] <= mujoco.mjtGeom.mjGEOM_HFIELD.value  # planes and height fields have no bounding sphere
        kinds = np.where(endless, -1, types[0] * 100 + types[1])
        self._of_kind = [kinds == kind for kind in np.unique(kinds[~endless])]
        self._reach = np.where(endless, np.inf, model.geom_rbound[self._first] + model.geom_rbound[self._second])
        self._endless = endless
        self._centre, self._half = model.geom_aabb[:, :3], model.geom_aabb[:, 3:]

    def near(self, pos: np.ndarray, mat: np.ndarray) -> tuple[int, np.ndarray]:
        """The most pairs of one type with overlapping spheres in any world; each world's with overlapping boxes, [S].

        Args:
            pos: positions of the geoms, metres, [S, ngeom, 3].
            mat: their rotations, [S, ngeom, 9].
        """
        near = np.linalg.norm(pos[:, self._first] - pos[:, self._second], axis=-1) <= self._reach
        of_one = [int(near[:, chosen].sum(1).max()) for chosen in self._of_kind]
        world, pair = np.nonzero(near)
        meets = self._boxes_meet(pos, mat.reshape(*mat.shape[:2], 3, 3), world, pair)
        return max(of_one, default=1), np.bincount(world, meets, len(pos))

    def _boxes_meet(self, pos: np.ndarray, mat: np.ndarray, world: np.ndarray, pair: np.ndarray) -> np.ndarray:
        """Whether the bounding boxes of these pairs overlap along all six axes of their faces; planes always do."""
        first, second = self._first[pair], self._second[pair]
        gap = self._middle(pos, mat, world, second) - self._middle(pos, mat, world, first)
        meets = np.ones(len(pair), bool)
        for turned in (mat[world, first], mat[world, second]):
            axes = np.swapaxes(turned, -1, -2)
            reach = np.zeros((len(pair), 3))
            for geom in (first, second):
                reach += (np.abs(axes @ mat[world, geom]) * self._half[geom][:, None]).sum(-1)
            meets &= (np.abs((axes @ gap[..., None])[..., 0]) <= reach).all(-1)
        return meets | self._endless[pair]

    def _middle(self, pos: np.ndarray, mat: np.ndarray, world: np.ndarray, geom: np.ndarray) -> np.ndarray:
        return pos[world, geom] + (mat[world, geom] @ self._centre[geom][..., None])[..., 0]
