"""Native physics: many MuJoCo simulations stepped on threads, each thread a few of them at a time.

In: scenes, which scene each slot runs, start states, and one 7-D action a slot per control step. Out: the state of
every slot after each control step, and the kinematics and contacts that goals read. Everything is float64 and
bit-identical at any thread count.

Slots of one scene form a group. A group is cut into blocks of up to eight slots, each a ``mujoco.batch.Batch`` with the
controllers of its arms, and a thread takes a block through all 25 substeps of a control step before it takes the next:
no thread waits for another within a control step, and the simulations of a block stay in the core's cache. What is read
when follows robosuite 1.4.0:

* The goal is judged on the kinematics and contacts at the *start* of the last substep, and on the joint positions at
  its end, because ``mj_step`` leaves them so.
* Proprioception is the sample robosuite's observables take, within the 24th substep of 25: kinematics after 23
  substeps, finger positions after 24 (its sampling clock, advanced twice by ``reset`` and ``set_init_state``).
* The first substep of an episode uses the controller's memory of the reset pose, not the stored start (robosuite's
  ``Controller.new_update`` flag is still down), for everything but gravity compensation.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeAlias, TypeVar

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from vecenv.controllers.osc_numba import ArmViews, Controllers
from vecenv.libero.physics.base import OBSERVED_FINGERS, OBSERVED_POSE, SUBSTEPS, Physics, Shown, Start
from vecenv.libero.physics.colliders import install as collider
from vecenv.libero.robot import ARM_JOINTS, HOME_QPOS
from vecenv.libero.scene.scene import Scene
from vecenv.util.cores import usable_cores

# Slots a thread steps at a time. Eight simulations stay in a core's cache; fewer spend more on calls.
BLOCK = 8

_POSITION_AND_VELOCITY = mujoco.mjtStage.mjSTAGE_VEL.value
_NO_STAGE = mujoco.mjtStage.mjSTAGE_NONE.value
_ALL_STAGES = mujoco.mjtStage.mjSTAGE_ACC.value

_FAULTS = {
    mujoco.mjtWarning.mjWARN_CONTACTFULL: "contact memory exhausted",
    mujoco.mjtWarning.mjWARN_CNSTRFULL: "constraint memory exhausted",
    mujoco.mjtWarning.mjWARN_INERTIA: "mass matrix not invertible",
    mujoco.mjtWarning.mjWARN_BADQPOS: "non-finite or huge position",
    mujoco.mjtWarning.mjWARN_BADQVEL: "non-finite or huge velocity",
    mujoco.mjtWarning.mjWARN_BADQACC: "non-finite or huge acceleration",
    mujoco.mjtWarning.mjWARN_BADCTRL: "non-finite control",
}

# Fields that are computed of the state.
_REFRESHED = ("xpos", "xquat", "xmat", "site_xpos", "site_xmat", "sensordata")
# Gripper targets after a quarter of a second of the action -1.
_OPEN = (1.0, -1.0)

_Rows: TypeAlias = np.ndarray | None
_Item = TypeVar("_Item")


class Workers:
    """Threads that step the blocks of a batch.

    Args:
        threads: how many; None for one a core.
    """

    def __init__(self, threads: int | None = None) -> None:
        self.threads = threads or usable_cores()
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None

    def each(self, call: Callable[[_Item], object], items: Collection[_Item]) -> None:
        """Call for every item and wait for all; any thread may take any item."""
        for _ in map(call, items) if self._pool is None or len(items) < 2 else self._pool.map(call, items):
            pass

    def close(self) -> None:
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown()


class Observed(NamedTuple):
    """Proprioception as robosuite's observables report it, a row a slot.

    Attributes:
        eef_pos: end-effector position, metres, [n, 3].
        eef_quat: hand orientation, wxyz, [n, 4].
        fingers: the two finger positions, metres, [n, 2].
    """

    eef_pos: np.ndarray
    eef_quat: np.ndarray
    fingers: np.ndarray

    @classmethod
    def zeros(cls, count: int) -> Observed:
        """Zeros for ``count`` slots."""
        return cls(np.zeros((count, 3)), np.zeros((count, 4)), np.zeros((count, 2)))


class _Block:
    """A few slots of one scene, stepped by one thread at a time.

    Args:
        scene: the scene.
        home: the arm at reset, as ``home_row`` gives it.
        slots: their indices in the batch, int [n].
        observed: written here, [n, ...].
        seen_qpos: likewise, [n, nq].
    """

    def __init__(
        self, scene: Scene, home: np.ndarray, slots: np.ndarray, observed: Observed, seen_qpos: np.ndarray
    ) -> None:
        self.scene, self.slots, self.observed, self.seen_qpos = scene, slots, observed, seen_qpos
        self.batch = Batch(scene.model, len(slots), 1, persistent=True)
        bind = self.batch.bind
        self._qpos, self._qvel, self._time = bind("qpos"), bind("qvel"), bind("time")
        self._xquat, self._site_xpos = bind("xquat"), bind("site_xpos")
        self._controllers = Controllers(arm_views(scene, self.batch), home[0])
        self._copies: list[tuple[str, np.ndarray, np.ndarray]] = []
        self._errors: dict[int, str] = {}

    def copy_to(self, field: str, target: np.ndarray) -> None:
        """Copy a MuJoCo field to ``target``, [n, ...], at the end of every call: the rows that the call computed."""
        self._copies.append((field, self.batch.bind(field), target))

    def held(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Arrays that ``refresh`` changes and later calls read, each with its content now."""
        copies = [target for name, _, target in self._copies if name in _REFRESHED]
        return [(array, array.copy()) for array in (self.batch.bind("qacc_warmstart"), *copies)]

    def place(self, rows: np.ndarray, start: Start) -> None:
        """Set the simulations ``rows`` to their start states."""
        self._guarded(self.batch.reset, rows, stage=_NO_STAGE)
        self.batch.warning[rows] = 0
        for row in rows.tolist():
            self._errors.pop(row, None)
        self._qpos[rows], self._qvel[rows], self._time[rows] = start.qpos, start.qvel, start.time
        if len(start.bodies):
            for field, poses in (("body_pos", start.body_pos), ("body_quat", start.body_quat)):
                self.batch.expand(field)[rows[:, None], start.bodies] = poses
        self._controllers.rearm(rows, fresh=not start.settled)
        if start.settled:
            self._controllers.memory["fingers"][rows] = _OPEN
        self.refresh(_ALL_STAGES, rows)
        self._observe_pose(rows)
        self._observe_fingers(rows)

    def write_state(self, qpos: np.ndarray, qvel: np.ndarray, time: np.ndarray) -> None:
        """Overwrite positions, velocities and time of all rows."""
        self._qpos[:], self._qvel[:], self._time[:] = qpos, qvel, time
        self.refresh(_ALL_STAGES)
        self._observe_pose(None)
        self._observe_fingers(None)

    def refresh(self, stage: int, rows: _Rows = None) -> None:
        """Compute the current state up to a stage and copy the fields."""
        self._guarded(self.batch.forward, rows, stage=stage)
        self._copy_fields(rows)

    def control_step(self, actions: np.ndarray, active: np.ndarray) -> None:
        """25 substeps of the active rows, bool [n], with their actions [n, 7]."""
        rows = None if active.all() else np.flatnonzero(active)
        self._guarded(self.batch.forward, rows, stage=_POSITION_AND_VELOCITY)
        self._controllers.take_actions(actions, active)
        for substep in range(1, SUBSTEPS + 1):
            self._controllers.command(active)
            self._guarded(self.batch.step, rows, stage=_NO_STAGE if substep == SUBSTEPS else _POSITION_AND_VELOCITY)
            if substep == OBSERVED_POSE:
                self._observe_pose(rows)
            elif substep == OBSERVED_FINGERS:
                self._observe_fingers(rows)
        self._copy_fields(rows)

    def faults(self) -> list[tuple[int, str]]:
        """Rows in which MuJoCo raised or warned since their start, and the cause."""
        found = list(self._errors.items())
        counts = self.batch.warning[:, :, 1]
        if counts.any():
            failed = np.flatnonzero(counts.max(axis=1)).tolist()
            found += [(row, _FAULTS[mujoco.mjtWarning(int(counts[row].argmax()))]) for row in failed]
        return found

    def _guarded(self, call: Callable[..., None], rows: _Rows, *, stage: int) -> None:
        """Call; where MuJoCo raises, the slot of that simulation gets a fault."""
        try:
            call(rows, stage=stage)
        except SimulationError as error:
            for row in error.ids.tolist():
                self._errors.setdefault(row, f"MuJoCo: {self.batch.error(row)}")

    def _copy_fields(self, rows: _Rows) -> None:
        chosen = slice(None) if rows is None else rows
        for _, live, target in self._copies:
            target[chosen] = live[chosen]

    def _observe_pose(self, rows: _Rows) -> None:
        chosen = slice(None) if rows is None else rows
        self.observed.eef_pos[chosen] = self._site_xpos[chosen, self.scene.grip_site]
        self.observed.eef_quat[chosen] = self._xquat[chosen, self.scene.hand_body]
        self.seen_qpos[chosen] = self._qpos[chosen]

    def _observe_fingers(self, rows: _Rows) -> None:
        chosen = slice(None) if rows is None else rows
        self.observed.fingers[chosen] = self._qpos[chosen][:, self.scene.finger_qpos]


class Group:
    """The slots of one scene. Arrays are read-only and as of the last call, in the world frame.

    Args:
        scene: the scene they share.
        slots: their indices in the batch, int [n].
        workers: threads to step them on; None for the calling thread alone.
        block: slots a thread steps at a time.

    Attributes:
        scene, slots: as given.
        qpos, qvel, time: state, [n, nq], [n, nv] and seconds [n].
        xpos, xquat, xmat, site_xpos, site_xmat: kinematics; bodies or sites second.
        touch: contact sensors as of the last full step, [n, nsensordata].
        observed: proprioception.
        seen_qpos: positions as camera images show them, those of ``observed``'s kinematics, [n, nq].
    """

    def __init__(self, scene: Scene, slots: np.ndarray, workers: Workers | None = None, block: int = BLOCK) -> None:
        self.scene, self.slots = scene, slots
        self._workers = workers or Workers(1)
        self.observed, self.seen_qpos = Observed.zeros(len(slots)), np.zeros((len(slots), scene.model.nq))
        bounds = np.linspace(0, len(slots), -(-len(slots) // block) + 1).astype(int).tolist()
        self._rows = [slice(low, high) for low, high in itertools.pairwise(bounds)]
        home = home_row(scene)
        self.blocks = [
            _Block(scene, home, slots[rows], Observed(*(array[rows] for array in self.observed)), self.seen_qpos[rows])
            for rows in self._rows
        ]
        self._bound: dict[str, np.ndarray] = {}
        self.qpos, self.qvel, self.time = self.bind("qpos"), self.bind("qvel"), self.bind("time")
        self.xpos, self.xquat, self.xmat = self.bind("xpos"), self.bind("xquat"), self.bind("xmat")
        self.site_xpos, self.site_xmat = self.bind("site_xpos"), self.bind("site_xmat")
        self.touch = self.bind("sensordata")

    def bind(self, field: str) -> np.ndarray:
        """A field of ``MjData`` of every slot, [n, ...]: read-only, and filled by the calls that follow."""
        if field not in self._bound:
            like = self.blocks[0].batch.bind(field)
            array = np.zeros((len(self.slots), *like.shape[1:]), like.dtype)
            for block, rows in zip(self.blocks, self._rows, strict=True):
                block.copy_to(field, array[rows])
            self._bound[field] = array.view()
            self._bound[field].flags.writeable = False
        return self._bound[field]

    def expand(self, field: str) -> np.ndarray:
        """A field of ``MjModel`` that may differ between slots, a copy, [n, ...]."""
        return np.concatenate([block.batch.expand(field) for block in self.blocks])

    def shown(self) -> Shown:
        """What camera images show now."""
        return Shown(self.slots, self.seen_qpos.copy(), self.expand("body_pos"), self.expand("body_quat"))

    @property
    def state(self) -> np.ndarray:
        """MuJoCo's integration state of every slot, a copy, [n, nstate]."""
        return np.concatenate([block.batch.state for block in self.blocks])

    def place(self, rows: np.ndarray, start: Start) -> None:
        """Begin an episode in ``rows``, int [k] ascending: physics state, fixture poses, controller memory."""

        def place(job: tuple[_Block, slice]) -> None:
            block, owned = job
            mine = (rows >= owned.start) & (rows < owned.stop)
            if mine.any():
                block.place(rows[mine] - owned.start, start.select(mine))

        self._workers.each(place, list(zip(self.blocks, self._rows, strict=True)))

    def write_state(self, qpos: np.ndarray, qvel: np.ndarray, time: np.ndarray) -> None:
        """Overwrite the physics state, [n, nq], [n, nv] and seconds [n]; the controllers keep their memory."""
        for block, rows in zip(self.blocks, self._rows, strict=True):
            block.write_state(qpos[rows], qvel[rows], time[rows])

    def refresh_kinematics(self) -> None:
        """Compute the kinematics of the current state."""
        self._workers.each(lambda block: block.refresh(_POSITION_AND_VELOCITY), self.blocks)

    def refresh_all(self) -> None:
        """Compute kinematics, contacts and contact sensors of the current state."""
        self._workers.each(lambda block: block.refresh(_ALL_STAGES), self.blocks)

    @contextlib.contextmanager
    def refreshed(self, *, contacts: bool = False) -> Iterator[None]:
        """Inside, kinematics (and contacts) are those of the current state; afterwards all is as it was."""
        held = [block.held() for block in self.blocks]
        (self.refresh_all if contacts else self.refresh_kinematics)()
        try:
            yield
        finally:
            for arrays in held:
                for array, before in arrays:
                    array[:] = before

    def faults(self) -> list[tuple[int, str]]:
        """Slots in which MuJoCo raised or warned since their start, and the cause."""
        return [(int(block.slots[row]), reason) for block in self.blocks for row, reason in block.faults()]


def arm_views(scene: Scene, batch: Batch) -> ArmViews:
    """What the controllers of a batch of this scene read and write.

    Raises:
        ValueError: the arm is not the scene's first kinematic chain.
    """
    model, bind, n = scene.model, batch.bind, batch.nsim
    joints = [model.joint(name) for name in ARM_JOINTS]
    if [joint.qposadr[0] for joint in joints] != list(range(7)) or list(model.M_rownnz[:7]) != list(range(1, 8)):
        raise ValueError("the arm must be the scene's first kinematic chain")
    site, first = scene.grip_site, joints[0].id
    sources = {
        "qpos": bind("qpos")[:, :7],
        "qvel": bind("qvel")[:, :7],
        "eef_pos": bind("site_xpos")[:, site],
        "eef_mat": bind("site_xmat")[:, site],
        "xanchor": bind("xanchor")[:, first : first + 7],
        "xaxis": bind("xaxis")[:, first : first + 7],
        "mass_lower": bind("M")[:, :28],
        "bias": bind("qfrc_bias")[:, :7],
        "ctrl": bind("ctrl"),
    }
    views = {name: source.reshape(n, -1) for name, source in sources.items()}
    for name, source in sources.items():
        if not np.shares_memory(views[name], source):
            raise ValueError(f"{name} is a copy, not a live view")
    return ArmViews(**views)


def home_row(scene: Scene) -> np.ndarray:
    """The arm as the controller first sees it in upstream's reset, arm at home, fingers at 0: [1, 103]."""
    batch = Batch(scene.model, 1, 1, persistent=True)
    views = arm_views(scene, batch)
    batch.bind("qpos")[0, scene.arm_qpos] = HOME_QPOS
    batch.forward(stage=_POSITION_AND_VELOCITY)
    return views.rows()


class NativePhysics(Physics[Group]):
    """The batch: ``num_envs`` slots in the caller's order.

    Args:
        scenes: distinct scenes.
        scene_of_slot: index into ``scenes`` of each slot, int [B].
        num_threads: threads; None for one a core.

    Raises:
        ColliderError: the scenes have published contacts, and the installed MuJoCo does not support them.
    """

    def __init__(self, scenes: Sequence[Scene], scene_of_slot: np.ndarray, num_threads: int | None = None) -> None:
        self.num_envs = len(scene_of_slot)
        if any(scene.contacts == "published" for scene in scenes):
            collider.install()
        self._workers = Workers(num_threads)
        block = _block_size(self.num_envs, self._workers.threads)
        used = [(scene, np.flatnonzero(scene_of_slot == index)) for index, scene in enumerate(scenes)]
        self._groups = [Group(scene, slots, self._workers, block) for scene, slots in used if len(slots)]
        self.faults = {}

    @property
    def groups(self) -> Sequence[Group]:
        """The slots by scene."""
        return self._groups

    @property
    def eef_pos(self) -> np.ndarray:
        """End-effector position as robosuite's observables report it, metres, [B, 3]."""
        return self._observed().eef_pos

    @property
    def eef_quat(self) -> np.ndarray:
        """Hand orientation likewise, wxyz, [B, 4]."""
        return self._observed().eef_quat

    @property
    def fingers(self) -> np.ndarray:
        """The two finger positions likewise, metres, [B, 2]."""
        return self._observed().fingers

    def place(self, group: Group, slots: np.ndarray, start: Start) -> None:
        """Begin an episode in ``slots``, which belong to ``group``: physics state, fixture poses, controller memory."""
        for slot in slots.tolist():
            self.faults.pop(slot, None)
        group.place(np.searchsorted(group.slots, slots), start)
        self._collect_faults()

    def write_state(self, group: Group, qpos: np.ndarray, qvel: np.ndarray, time: np.ndarray) -> None:
        """Overwrite the physics state of a group ([n, nq], [n, nv], seconds [n]); the controller keeps its memory."""
        group.write_state(qpos, qvel, time)
        self._collect_faults()

    def control_step(self, actions: np.ndarray, active: np.ndarray) -> None:
        """Advance the active slots by one control step: 25 substeps, 50 ms.

        Args:
            actions: finite actions within [-1, 1], [B, 7].
            active: slots to advance, bool [B]; the others keep their state.
        """
        actions = np.asarray(actions, np.float64)
        blocks = [block for group in self.groups for block in group.blocks if active[block.slots].any()]
        self._workers.each(lambda block: block.control_step(actions[block.slots], active[block.slots]), blocks)
        self._collect_faults()

    def close(self) -> None:
        """Stop the threads."""
        self._workers.close()

    def _observed(self) -> Observed:
        """Proprioception of all groups, in the caller's order of slots."""
        whole = Observed.zeros(self.num_envs)
        for group in self.groups:
            for target, values in zip(whole, group.observed, strict=True):
                target[group.slots] = values
        return whole

    def _collect_faults(self) -> None:
        for group in self.groups:
            for slot, reason in group.faults():
                self.faults.setdefault(slot, reason)


def _block_size(slots: int, threads: int) -> int:
    """At most ``BLOCK`` slots, so that the blocks of one scene are spread evenly over the threads."""
    rounds = math.ceil(slots / (threads * BLOCK))
    return math.ceil(slots / (threads * rounds))
