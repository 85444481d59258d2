"""Native physics: many MuJoCo simulations stepped by C threads, controlled by one jitted JAX function.

In: scenes, which scene each slot runs, start states, and one 7-D action a slot per control step. Out: the state of
every slot after each control step, and the kinematics and contacts that goals read. Everything is float64 and
bit-identical at any thread count.

Slots of one scene form a group, a ``mujoco.batch.Batch``. A control step is 25 physics substeps; each substep gathers
the arms of all groups into one array, calls the controller once for the whole batch, and steps the groups. What is read
when follows robosuite 1.4.0:

* The goal is judged on the kinematics and contacts at the *start* of the last substep, and on the joint positions at
  its end, because ``mj_step`` leaves them so.
* Proprioception is the sample robosuite's observables take, within the 24th substep of 25: kinematics after 23
  substeps, finger positions after 24 (its sampling clock, advanced twice by ``reset`` and ``set_init_state``).
* The first substep of an episode uses the controller's memory of the reset pose, not the stored start (robosuite's
  ``Controller.new_update`` flag is still down), for everything but gravity compensation.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from vecenv.controllers import osc
from vecenv.libero.scene import ARM_JOINTS, HOME_QPOS, Scene
from vecenv.machine import usable_cores

SUBSTEPS = 25
# Substeps after which robosuite's observables have read the kinematics and the finger joints (see the docstring above).
_OBSERVED_POSE = 23
_OBSERVED_FINGERS = 24

_POSITION_AND_VELOCITY = mujoco.mjtStage.mjSTAGE_VEL.value
_NOTHING = mujoco.mjtStage.mjSTAGE_NONE.value
_EVERYTHING = mujoco.mjtStage.mjSTAGE_ACC.value

_FAULTS = {
    mujoco.mjtWarning.mjWARN_CONTACTFULL: "contact memory exhausted",
    mujoco.mjtWarning.mjWARN_CNSTRFULL: "constraint memory exhausted",
    mujoco.mjtWarning.mjWARN_INERTIA: "mass matrix not invertible",
    mujoco.mjtWarning.mjWARN_BADQPOS: "non-finite or huge position",
    mujoco.mjtWarning.mjWARN_BADQVEL: "non-finite or huge velocity",
    mujoco.mjtWarning.mjWARN_BADQACC: "non-finite or huge acceleration",
    mujoco.mjtWarning.mjWARN_BADCTRL: "non-finite control",
}

# Gripper targets after a quarter of a second of the action -1.
_OPEN = (1.0, -1.0)

_FIELD = osc.packed_slices()
_Rows: TypeAlias = np.ndarray | None


@dataclass(frozen=True, kw_only=True)
class Start:
    """Start states of n slots of one scene.

    Attributes:
        qpos: [n, nq].
        qvel: [n, nv].
        bodies: ids of the bodies whose poses are given, [F].
        body_pos: their positions in metres, world frame, [n, F, 3].
        body_quat: their orientations wxyz, [n, F, 4].
        time: simulated seconds the starts have run for.
        settled: the starts have already been stepped with an idle arm and an opening gripper, so the controller sees
            them as they are; otherwise it still remembers the pose of the reset.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    bodies: np.ndarray
    body_pos: np.ndarray
    body_quat: np.ndarray
    time: float = 0.0
    settled: bool = False


class Group:
    """The slots of one scene.

    Attributes:
        scene: the scene they share.
        slots: their indices in the batch, int [n].
        qpos, qvel: live state, [n, nq] and [n, nv].
        xpos, xquat, site_xpos, site_xmat: kinematics as of the last call, world frame.
        touch: contact sensors as of the last full step, [n, nsensordata].
    """

    def __init__(self, scene: Scene, slots: np.ndarray, num_threads: int) -> None:
        self.scene, self.slots = scene, slots
        self.batch = Batch(scene.model, len(slots), num_threads, persistent=True)
        bind = self.batch.bind
        self.qpos, self.qvel, self.time, self.ctrl = bind("qpos"), bind("qvel"), bind("time"), bind("ctrl")
        self.xpos, self.xquat, self.xmat = bind("xpos"), bind("xquat"), bind("xmat")
        self.site_xpos, self.site_xmat = bind("site_xpos"), bind("site_xmat")
        self.touch = bind("sensordata")
        self._arm_fields = _arm_fields(self)
        self._body_pos: np.ndarray | None = None
        self._body_quat: np.ndarray | None = None

    def place(self, rows: np.ndarray, start: Start) -> None:
        """Put the simulations ``rows`` into their start states."""
        self.batch.reset(rows, stage=_NOTHING)
        self.batch.warning[rows] = 0
        self.qpos[rows], self.qvel[rows], self.time[rows] = start.qpos, start.qvel, start.time
        if len(start.bodies):
            if self._body_pos is None or self._body_quat is None:
                self._body_pos, self._body_quat = self.batch.expand("body_pos"), self.batch.expand("body_quat")
            self._body_pos[rows[:, None], start.bodies] = start.body_pos
            self._body_quat[rows[:, None], start.bodies] = start.body_quat
        self.batch.forward(rows, stage=_EVERYTHING)

    def refresh_kinematics(self) -> None:
        """Bring the kinematics up to the present state."""
        self.batch.forward(stage=_POSITION_AND_VELOCITY)

    def refresh_all(self) -> None:
        """Bring kinematics, contacts and contact sensors up to the present state."""
        self.batch.forward(stage=_EVERYTHING)

    def gather_arm(self, out: np.ndarray) -> None:
        """Write the arm's packed rows, [n, 103]."""
        for columns, field in self._arm_fields:
            out[:, columns] = field

    def faults(self) -> list[tuple[int, str]]:
        """Rows that MuJoCo warned about since their start, and why."""
        counts = self.batch.warning[:, :, 1]
        failed = np.flatnonzero(counts.max(axis=1))
        return [(int(row), _FAULTS[mujoco.mjtWarning(int(counts[row].argmax()))]) for row in failed]


def _arm_fields(group: Group) -> list[tuple[slice, np.ndarray]]:
    """Live views of everything the controller reads, with their columns in the packed row."""
    model, bind, n = group.scene.model, group.batch.bind, len(group.slots)
    joints = [model.joint(name) for name in ARM_JOINTS]
    if [joint.qposadr[0] for joint in joints] != list(range(7)) or list(model.M_rownnz[:7]) != list(range(1, 8)):
        raise ValueError("the arm must be the scene's first kinematic chain")
    site = group.scene.grip_site
    first = joints[0].id
    sources = {
        "qpos": group.qpos[:, :7],
        "qvel": group.qvel[:, :7],
        "eef_pos": group.site_xpos[:, site],
        "eef_mat": group.site_xmat[:, site],
        "xanchor": bind("xanchor")[:, first : first + 7],
        "xaxis": bind("xaxis")[:, first : first + 7],
        "mass_lower": bind("M")[:, :28],
        "bias": bind("qfrc_bias")[:, :7],
    }
    views = {name: source.reshape(n, -1) for name, source in sources.items()}
    for name, source in sources.items():
        if not np.shares_memory(views[name], source):
            raise ValueError(f"{name} is a copy, not a live view")
    return [(_FIELD[name], view) for name, view in views.items()]


class NativePhysics:
    """The batch: ``num_envs`` slots in the caller's order.

    Args:
        scenes: distinct scenes.
        scene_of_slot: index into ``scenes`` of each slot, int [B].
        num_threads: C threads; None for one a core.

    Attributes:
        groups: the slots by scene.
        eef_pos: end-effector position as robosuite's observables report it, metres, [B, 3].
        eef_quat: hand orientation likewise, wxyz, [B, 4].
        fingers: the two finger positions likewise, metres, [B, 2].
        faults: why the physics of a slot failed, by slot; empty when all are healthy.
    """

    def __init__(self, scenes: Sequence[Scene], scene_of_slot: np.ndarray, num_threads: int | None = None) -> None:
        self.num_envs = len(scene_of_slot)
        threads = num_threads or usable_cores()
        used = [(scene, np.flatnonzero(scene_of_slot == index)) for index, scene in enumerate(scenes)]
        used = [(scene, slots) for scene, slots in used if len(slots)]
        # One group: MuJoCo's threads share its slots. Several: each of our threads steps whole groups.
        spread = len(used) > 1
        self.groups = [Group(scene, slots, 1 if spread else threads) for scene, slots in used]
        self._pool = ThreadPoolExecutor(min(threads, len(used))) if spread and threads > 1 else None
        # Inside, slots are ordered by group: slot order[i] is the i-th, group g owns the range ranges[g].
        self._order = np.concatenate([group.slots for group in self.groups])
        bounds = np.cumsum([0, *(len(group.slots) for group in self.groups)]).tolist()
        self._ranges = [slice(low, high) for low, high in itertools.pairwise(bounds)]
        self._packed = np.zeros((self.num_envs, osc.PACKED_SIZE))
        # The controller's memory; fresh slots have not run since they were placed.
        self._substeps = _controller()
        home = np.concatenate([np.repeat(home_row(g.scene), len(g.slots), 0) for g in self.groups])
        self._memory = self._substeps.start(home)
        self._fresh = np.ones(self.num_envs, bool)
        self.eef_pos = np.zeros((self.num_envs, 3))
        self.eef_quat = np.zeros((self.num_envs, 4))
        self.fingers = np.zeros((self.num_envs, 2))
        self.faults: dict[int, str] = {}

    def serves(self, scenes: Sequence[Scene], scene_of_slot: np.ndarray) -> bool:
        """Whether this batch already has these scenes in these slots."""
        if len(scene_of_slot) != self.num_envs:
            return False
        wanted = [scenes[int(index)] for index in scene_of_slot]
        return all(wanted[slot] is group.scene for group in self.groups for slot in group.slots)

    def place(self, group: Group, slots: np.ndarray, start: Start) -> None:
        """Begin an episode in ``slots``, all of ``group``: physics state, fixture poses, controller memory."""
        rows = np.searchsorted(group.slots, slots)
        for slot in slots.tolist():
            self.faults.pop(slot, None)
        self._guarded(group, lambda: group.place(rows, start))
        placed = np.isin(self._order, slots)
        self._fresh[placed] = not start.settled
        self._memory = self._substeps.rearm(self._memory, placed)
        if start.settled:
            self._memory = _open_grippers(self._memory, placed)
        self._observe_pose(group, rows)
        self._observe_fingers(group, rows)

    def write_state(self, group: Group, qpos: np.ndarray, qvel: np.ndarray, time: np.ndarray) -> None:
        """Overwrite the physics state of a group ([n, nq], [n, nv], seconds [n]); the controller keeps its memory."""
        group.qpos[:], group.qvel[:], group.time[:] = qpos, qvel, time
        self._guarded(group, group.refresh_all)
        self._observe_pose(group, None)
        self._observe_fingers(group, None)
        self._collect_faults()

    def control_step(self, actions: np.ndarray, active: np.ndarray) -> None:
        """Advance the active slots by one control step: 25 substeps, 50 ms.

        Args:
            actions: finite actions within [-1, 1], [B, 7].
            active: slots to advance, bool [B]; the others keep their state.
        """
        runs = [(group, _rows(active[group.slots])) for group in self.groups if active[group.slots].any()]
        if not runs:
            return
        moving = active[self._order]
        inner_actions = np.where(moving[:, None], actions[self._order], 0.0)
        self._each(runs, lambda group, rows: group.batch.forward(rows, stage=_POSITION_AND_VELOCITY))
        for substep in range(1, SUBSTEPS + 1):
            self._command(inner_actions, moving, first=substep == 1)
            self._each(runs, _last_step if substep == SUBSTEPS else _step)
            if substep in (_OBSERVED_POSE, _OBSERVED_FINGERS):
                observe = self._observe_pose if substep == _OBSERVED_POSE else self._observe_fingers
                for group, rows in runs:
                    observe(group, rows)
        self._fresh[moving] = False
        self._collect_faults()

    def close(self) -> None:
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def _command(self, actions: np.ndarray, moving: np.ndarray, *, first: bool) -> None:
        """Gather every arm, run the controller once for the whole batch, hand out the commands."""
        for group, rows in zip(self.groups, self._ranges, strict=True):
            group.gather_arm(self._packed[rows])
        if first:
            commands = self._begin(actions, moving)
        else:
            commands, self._memory = self._substeps.proceed(self._memory, self._packed)
        for group, rows in zip(self.groups, self._ranges, strict=True):
            group.ctrl[:] = commands[rows]

    def _begin(self, actions: np.ndarray, moving: np.ndarray) -> np.ndarray:
        before = self._memory
        commands, self._memory = self._substeps.begin(before, self._packed, actions, self._fresh)
        if not moving.all():
            # A slot that stands still keeps its goal; its gripper action is 0, which keeps its gripper.
            self._memory = self._memory._replace(goal=_choose_goals(moving, self._memory.goal, before.goal))
        return commands

    def _each(self, runs: Sequence[tuple[Group, _Rows]], call: Callable[[Group, _Rows], None]) -> None:
        """Call for every group, on the pool when there is one."""

        def guarded(run: tuple[Group, _Rows]) -> None:
            self._guarded(run[0], lambda: call(*run))

        for _ in map(guarded, runs) if self._pool is None else self._pool.map(guarded, runs):
            pass

    def _guarded(self, group: Group, call: Callable[[], None]) -> None:
        """Call; a simulation in which MuJoCo raises becomes a fault of its slot."""
        try:
            call()
        except SimulationError as error:
            for row in error.ids:
                self.faults[int(group.slots[row])] = f"MuJoCo: {group.batch.error(int(row))}"

    def _observe_pose(self, group: Group, rows: _Rows) -> None:
        chosen = slice(None) if rows is None else rows
        slots = group.slots[chosen]
        self.eef_pos[slots] = group.site_xpos[chosen, group.scene.grip_site]
        self.eef_quat[slots] = group.xquat[chosen, group.scene.hand_body]

    def _observe_fingers(self, group: Group, rows: _Rows) -> None:
        chosen = slice(None) if rows is None else rows
        self.fingers[group.slots[chosen]] = group.qpos[chosen][:, group.scene.finger_qpos]

    def _collect_faults(self) -> None:
        for group in self.groups:
            for row, reason in group.faults():
                self.faults.setdefault(int(group.slots[row]), reason)


@functools.cache
def _controller() -> osc.Substeps:
    """The compiled controller, shared so that each batch size compiles once a process."""
    return osc.compile_substeps()


def _open_grippers(memory: osc.ControlState, mask: np.ndarray) -> osc.ControlState:
    """The controllers with the gripper targets of the slots in the mask, bool [B], all the way open."""
    with jax.enable_x64(True):
        return memory._replace(gripper=jnp.where(mask[:, None], jnp.array(_OPEN), memory.gripper))


def _choose_goals(mask: np.ndarray, goal: osc.OscGoal, other: osc.OscGoal) -> osc.OscGoal:
    """``goal`` where the mask, bool [B], holds, else ``other``."""
    with jax.enable_x64(True):
        return osc.OscGoal(
            jnp.where(mask[:, None], goal.pos, other.pos), jnp.where(mask[:, None, None], goal.mat, other.mat)
        )


def home_row(scene: Scene) -> np.ndarray:
    """The arm as the controller first sees it in upstream's reset, arm at home, fingers at 0: a packed row [1, 103]."""
    group = Group(scene, np.zeros(1, int), 1)
    group.qpos[0, scene.arm_qpos] = HOME_QPOS
    group.refresh_kinematics()
    packed = np.zeros((1, osc.PACKED_SIZE))
    group.gather_arm(packed)
    return packed


def _step(group: Group, rows: _Rows) -> None:
    group.batch.step(rows, stage=_POSITION_AND_VELOCITY)


def _last_step(group: Group, rows: _Rows) -> None:
    group.batch.step(rows, stage=_NOTHING)


def _rows(active: np.ndarray) -> _Rows:
    """Indices of the active rows, or None for all."""
    return None if active.all() else np.flatnonzero(active)
