"""The MJX backend: a batch of worlds behind the interface of ``vecenv.libero.physics.base``.

In: scenes made ready (``Build``), which scene each slot runs, start states, goals, and actions or plans. Out: the state
of every slot as NumPy arrays, fetched from the device on access. Chunks of actions and plans of waypoints run in
one compiled call a scene.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt
from jax.sharding import Mesh
from mujoco import mjx

from vecenv.controllers import waypoint
from vecenv.libero.physics.base import FollowResult, Physics, RunResult, Shown, Start, Watcher
from vecenv.libero.physics.mjx.model import Build
from vecenv.libero.physics.mjx.options import MjxError
from vecenv.libero.physics.mjx.programs import programs_of
from vecenv.libero.physics.mjx.rollout import Loop, Trace
from vecenv.libero.physics.mjx.step import World, fault_text
from vecenv.libero.scene import goals
from vecenv.util.arrays import AnyArray
from vecenv.util.devices import replicated

log = logging.getLogger(__name__)


class MjxGroup:
    """The slots of one scene on the device; NumPy copies are fetched on access."""

    def __init__(self, built: Build, slots: np.ndarray, mesh: Mesh | None) -> None:
        self.scene, self.slots, self.built = built.scene, slots, built
        self.compiled, self.mesh = programs_of(built, mesh), mesh
        devices = 1 if mesh is None else mesh.size
        # Every device gets the same number of worlds; those past the last slot never move.
        self.num_worlds = -(-len(slots) // devices) * devices
        self.system, blank = built.system, built.blank(self.num_worlds // devices)
        if mesh is not None:
            self.system, blank = jax.device_put((self.system, blank), replicated(mesh))
        qpos = self.put(np.tile(np.asarray(blank.qpos), (len(slots), 1)))
        self.worlds: World = self.compiled.create(self.system, blank, qpos)
        self.table: goals.GoalTable | None = None
        self._fresh: mjx.Data | None = None
        self._fetched: dict[str, np.ndarray] = {}
        self._called: set[object] = set()

    @contextmanager
    def compiling(self, program: str, *shape: object) -> Iterator[None]:
        """Within the context a program is called; of the first call with these shapes the log says how long it took."""
        if (program, shape) in self._called:
            yield
            return
        self._called.add((program, shape))
        what = f"{program} of {self.num_worlds} worlds with {self.built.model.nv} degrees of freedom"
        log.info("tracing and compiling: %s", what)
        started = time.monotonic()
        yield
        log.info("ready after %.1f s: %s", time.monotonic() - started, what)

    def replace(self, worlds: World) -> None:
        """Replace the batch after a call."""
        self.worlds, self._fresh, self._fetched = worlds, None, {}

    def put(self, array: npt.ArrayLike) -> jax.Array:
        """Rows of slots as rows of worlds on the device: floats (32 bits unless x64 is on), int32 or bool."""
        array = np.asarray(array)
        missing = self.num_worlds - len(self.slots)
        array = np.concatenate([array, np.repeat(array[-1:], missing, axis=0)]) if missing else array
        if array.dtype.kind == "f":
            return jnp.asarray(array, jnp.result_type(float))
        return jnp.asarray(array, jnp.int32 if array.dtype.kind in "iu" else bool)

    def put_mask(self, mask: np.ndarray) -> jax.Array:
        """Which slots take part, bool [n]; worlds past the last slot never do."""
        return jnp.asarray(np.concatenate([mask, np.zeros(self.num_worlds - len(self.slots), bool)]))

    def get(self, array: AnyArray) -> np.ndarray:
        """Rows of the slots as a NumPy array."""
        return np.asarray(array)[: len(self.slots)]

    def _fetch(self, name: str) -> np.ndarray:
        if name not in self._fetched:
            source = self._fresh if self._fresh is not None else self.worlds.data
            self._fetched[name] = self.get(getattr(source, name)).astype(float)
        return self._fetched[name]

    @property
    def qpos(self) -> np.ndarray:
        """[n, nq]."""
        return self._fetch("qpos")

    @property
    def seen_qpos(self) -> np.ndarray:
        """[n, nq]: as camera images show them."""
        return self.get(self.worlds.seen_qpos).astype(float)

    @property
    def qvel(self) -> np.ndarray:
        """[n, nv]."""
        return self._fetch("qvel")

    @property
    def time(self) -> np.ndarray:
        """Simulated seconds, [n]."""
        return self._fetch("time").reshape(len(self.slots))

    @property
    def xpos(self) -> np.ndarray:
        """[n, nbody, 3]."""
        return self._fetch("xpos")

    @property
    def xquat(self) -> np.ndarray:
        """[n, nbody, 4]."""
        return self._fetch("xquat")

    @property
    def xmat(self) -> np.ndarray:
        """[n, nbody, 9]."""
        return self._fetch("xmat").reshape(len(self.slots), -1, 9)

    @property
    def site_xpos(self) -> np.ndarray:
        """[n, nsite, 3]."""
        return self._fetch("site_xpos")

    @property
    def site_xmat(self) -> np.ndarray:
        """[n, nsite, 9]."""
        return self._fetch("site_xmat").reshape(len(self.slots), -1, 9)

    @property
    def touch(self) -> np.ndarray:
        """[n, nsensordata]."""
        return self._fetch("sensordata")

    def shown(self) -> Shown:
        """What camera images show now; the next step takes the memory of the worlds, so these are copies."""
        worlds = self.worlds
        return Shown(self.slots, *_copies((worlds.seen_qpos, worlds.body_pos, worlds.body_quat)), mesh=self.mesh)

    def expand(self, field: str) -> np.ndarray:
        """``body_pos`` or ``body_quat`` of every slot, a copy, [n, nbody, ...]."""
        return self.get(getattr(self.worlds, field)).astype(float)

    def refresh_kinematics(self) -> None:
        """Compute the kinematics of the current state."""
        self.refresh_all()

    def refresh_all(self) -> None:
        """Compute kinematics, contacts and contact sensors of the current state."""
        self._fresh, self._fetched = self.compiled.forward(self.system, self.worlds), {}

    @contextmanager
    def refreshed(self, *, contacts: bool = False) -> Iterator[None]:
        """Inside, kinematics and contacts are those of the current state; afterwards all is as it was."""
        del contacts
        before = self._fresh, self._fetched
        self.refresh_all()
        try:
            yield
        finally:
            self._fresh, self._fetched = before


class MjxPhysics(Physics[MjxGroup]):
    """A batch of worlds on MJX, slots in the caller's order.

    Args:
        builds: distinct scenes on the device.
        scene_of_slot: index into ``builds`` of each slot, int [B].
        num_devices: spread every scene's slots over this many devices.

    Raises:
        MjxError: there are not that many devices.
    """

    def __init__(self, builds: Sequence[Build], scene_of_slot: np.ndarray, num_devices: int = 1) -> None:
        self.num_envs = len(scene_of_slot)
        mesh = _mesh(num_devices)
        used = [(built, np.flatnonzero(scene_of_slot == index)) for index, built in enumerate(builds)]
        self._groups = [MjxGroup(built, slots, mesh) for built, slots in used if len(slots)]
        self.faults: dict[int, str] = {}

    @property
    def groups(self) -> Sequence[MjxGroup]:
        """The slots by scene."""
        return self._groups

    @property
    def eef_pos(self) -> np.ndarray:
        """End-effector position as robosuite's observables report it, metres, [B, 3]."""
        return self._gather("eef_pos", 3)

    @property
    def eef_quat(self) -> np.ndarray:
        """Hand orientation likewise, wxyz, [B, 4]."""
        return self._gather("eef_quat", 4)

    @property
    def fingers(self) -> np.ndarray:
        """The two finger positions likewise, metres, [B, 2]."""
        return self._gather("fingers", 2)

    def _gather(self, name: str, width: int) -> np.ndarray:
        out = np.zeros((self.num_envs, width))
        for group in self._groups:
            out[group.slots] = group.get(getattr(group.worlds, name))
        return out

    def set_goals(self, tables: Sequence[goals.GoalTable]) -> None:
        """Set the goals of the slots: one table a group, rows in the order of its slots."""
        super().set_goals(tables)
        for group, table in zip(self._groups, tables, strict=True):
            group.table = jax.tree.map(group.put, table)

    def place(self, group: MjxGroup, slots: np.ndarray, start: Start) -> None:
        """Begin an episode in ``slots``, which belong to ``group``: physics state, fixture poses, controller memory."""
        n = len(group.slots)
        rows = np.searchsorted(group.slots, slots)
        mask = np.zeros(n, bool)
        mask[rows] = True
        for slot in slots.tolist():
            self.faults.pop(slot, None)
        bodies = _spread_bodies(group.built.scene.model, n, rows, start)
        qpos, qvel = np.array(group.qpos), np.array(group.qvel)
        qpos[rows], qvel[rows] = start.qpos, start.qvel
        state = (qpos, qvel, np.full(n, start.time), np.full(n, start.settled))
        arrays = jax.tree.map(group.put, (bodies, state))
        with group.compiling("start"):
            group.replace(group.compiled.start(group.system, group.worlds, group.put_mask(mask), *arrays))
        self._collect_faults()

    def write_state(self, group: MjxGroup, qpos: np.ndarray, qvel: np.ndarray, time: np.ndarray) -> None:
        """Overwrite the physics state of a group ([n, nq], [n, nv], seconds [n]); the controller keeps its memory."""
        arrays = map(group.put, (qpos, qvel, time))
        group.replace(group.compiled.write(group.system, group.worlds, *arrays))
        self._collect_faults()

    def control_step(self, actions: np.ndarray, active: np.ndarray) -> None:
        """Advance the active slots by one control step: 25 substeps, 50 ms."""
        self.run(actions[:, None], active, np.ones(self.num_envs, int))

    def run(
        self,
        chunk: np.ndarray,
        active: np.ndarray,
        limit: np.ndarray,
        watchers: Sequence[Watcher] = (),
        *,
        until_success: bool = True,
    ) -> RunResult:
        """Execute a chunk of actions in one compiled call a scene; see ``Physics.run``.

        Watchers are called afterwards, in the order of the ticks.
        """

        if not chunk.shape[1]:  # no program is compiled to do nothing
            return RunResult(*(np.zeros(self.num_envs, kind) for kind in (int, bool, bool)))

        def call(group: MjxGroup) -> tuple[Loop, None]:
            rows = group.put(chunk[group.slots]), group.put_mask(active[group.slots]), group.put(limit[group.slots])
            with group.compiling("step", chunk.shape[1], until_success):
                return group.compiled.run(until_success)(group.system, _table(group), group.worlds, *rows), None

        ran, _ = self._each(active, call)
        for k in range(chunk.shape[1]):
            moved = ran.ticks > k
            for watcher in watchers if moved.any() else ():
                watcher(chunk[:, k], moved)
        return ran

    def follow(
        self,
        plan: waypoint.WaypointPlan,
        active: np.ndarray,
        limit: np.ndarray,
        config: waypoint.WaypointConfig,
        *,
        max_misses: int | None = None,
        watchers: Sequence[Watcher] = (),
        until_success: bool = True,
        reference: np.ndarray | None = None,
    ) -> FollowResult:
        """Follow plans in one compiled call a scene; see ``Physics.follow``.

        Watchers are called afterwards, in the order of the ticks.
        """
        longest = np.where(plan.valid, np.where(plan.hold > 0, plan.hold, config.max_steps), 0).sum(1)
        traced = int(min(longest.max(initial=0), limit.max(initial=0))) if watchers else 0
        misses = jnp.int32(2**30 if max_misses is None else max_misses)
        carried = np.full((self.num_envs, 7), np.nan) if reference is None else reference

        def call(group: MjxGroup) -> tuple[Loop, Any]:
            group_plan = jax.tree.map(lambda x: group.put(np.asarray(x)[group.slots]), plan)
            rows = group_plan, group.put_mask(active[group.slots]), group.put(limit[group.slots])
            rows = *rows, group.put(carried[group.slots])
            follow = group.compiled.follow(config, traced, until_success)
            with group.compiling("waypoints", config, traced, until_success, plan.valid.shape[1]):
                loop, *rest = follow(group.system, misses, _table(group), group.worlds, *rows)
            return loop, rest

        ran, results = self._each(active, call)
        converged = np.zeros(plan.valid.shape, bool)
        ticks, ended = np.zeros(plan.valid.shape, int), carried.copy()
        for group, (progress, _) in results:
            converged[group.slots], ticks[group.slots] = group.get(progress.converged), group.get(progress.ticks)
            ended[group.slots] = np.concatenate([group.get(part) for part in progress.reference], axis=1)
        _replay(watchers, traced, self.num_envs, [(group, trace) for group, (_, trace) in results])
        return FollowResult(**vars(ran), converged=converged, waypoint_ticks=ticks, reference=ended)

    def _each(
        self, active: np.ndarray, call: Callable[[MjxGroup], tuple[Loop, Any]]
    ) -> tuple[RunResult, list[tuple[MjxGroup, Any]]]:
        """Call for every group with an active slot; all calls are started before the first result is awaited."""
        calls = [(group, call(group)) for group in self._groups if active[group.slots].any()]
        ran = RunResult(*(np.zeros(self.num_envs, kind) for kind in (int, bool, bool)))
        for group, (loop, _) in calls:
            group.replace(loop.worlds)
            found = {name: getattr(loop, name) for name in vars(ran)} | {"fault": loop.worlds.fault}
            found = jax.device_get(found)  # one wait for all of them
            for name, array in vars(ran).items():
                array[group.slots] = group.get(found[name])
            self._note_faults(group, group.get(found["fault"]))
        return ran, [(group, extra) for group, (_, extra) in calls]

    def _collect_faults(self) -> None:
        for group in self._groups:
            self._note_faults(group, group.get(group.worlds.fault))

    def _note_faults(self, group: MjxGroup, bits: np.ndarray) -> None:
        for row in np.flatnonzero(bits):
            self.faults.setdefault(int(group.slots[row]), fault_text(int(bits[row])))

    def close(self) -> None:
        """Release the worlds."""
        self._groups = []


@jax.jit
def _copies(arrays: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    return tuple(map(jnp.copy, arrays))


def _table(group: MjxGroup) -> goals.GoalTable:
    if group.table is None:
        raise MjxError("call set_goals before stepping")
    return group.table


def _mesh(num_devices: int) -> Mesh | None:
    available = jax.devices()
    if not 1 <= num_devices <= len(available):
        raise MjxError(f"num_devices={num_devices}: JAX sees {len(available)} ({available[0].platform})")
    return None if num_devices == 1 else Mesh(np.array(available[:num_devices]), ("worlds",))


def _spread_bodies(model: mujoco.MjModel, n: int, rows: np.ndarray, start: Start) -> tuple[np.ndarray, np.ndarray]:
    """Body positions [n, nbody, 3] and orientations [n, nbody, 4] with the start's poses in its rows."""
    pos, quat = np.tile(model.body_pos, (n, 1, 1)), np.tile(model.body_quat, (n, 1, 1))
    if len(start.bodies):
        pos[rows[:, None], start.bodies] = start.body_pos
        quat[rows[:, None], start.bodies] = start.body_quat
    return pos, quat


def _replay(watchers: Sequence[Watcher], count: int, num_envs: int, traces: list[tuple[MjxGroup, Trace]]) -> None:
    """Call the watchers with the recorded actions."""
    if not watchers:
        return
    actions, moved = np.zeros((num_envs, count, 7)), np.zeros((num_envs, count), bool)
    for group, trace in traces:
        actions[group.slots], moved[group.slots] = group.get(trace.actions), group.get(trace.moved)
    for k in np.flatnonzero(moved.any(axis=0)):
        for watcher in watchers:
            watcher(actions[:, k], moved[:, k])
