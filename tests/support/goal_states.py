"""States at and around the edges of a task's goal, for parity tests of verdicts.

In: a task and its scene. Out: rows of qpos in which the goal holds, and rows that differ from those in one predicate by
1e-7 to 1e-2 (metres, radians) across one of its borders: sides of a region, its lower and upper bound, first contact,
the radius of a support, the threshold of a joint. Rows need not be physically possible, only well defined.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from vecenv.libero.physics.colliders import install as collider
from vecenv.libero.scene import goals
from vecenv.libero.scene.bddl import Predicate, Problem
from vecenv.libero.scene.scene import Scene

STEPS = (1e-7, 1e-4, 1e-2)
_BOTH_SIDES = [sign * step for sign in (-1.0, 1.0) for step in STEPS]
_SCAN = 0.002
_TRIES = 12


class Simulation:
    """One state of a scene, with the poses of its fixtures: what goals read of it."""

    def __init__(self, scene: Scene) -> None:
        if scene.contacts == "published":
            collider.install()
        self.scene = scene
        self.model = copy.copy(scene.model)
        self.data = mujoco.MjData(self.model)

    def stand(self, bodies: Sequence[int], pos: np.ndarray, quat: np.ndarray) -> None:
        """Put fixtures elsewhere: body ids [F], positions [F, 3] in metres, quaternions wxyz [F, 4]."""
        self.model.body_pos[bodies], self.model.body_quat[bodies] = pos, quat

    def load(self, qpos: np.ndarray) -> None:
        """Kinematics, contacts and sensors of a state at rest, qpos [nq]."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)

    def reads(self, states: Sequence[np.ndarray]) -> dict[str, Any]:
        """The arguments of ``goals.evaluate`` for n states."""
        fields: dict[str, list[np.ndarray]] = {name: [] for name in ("xpos", "site_xpos", "site_xmat", "qpos", "touch")}
        for state in states:
            self.load(state)
            for name, rows in fields.items():
                rows.append(getattr(self.data, "sensordata" if name == "touch" else name).copy())
        return {name: np.stack(rows) for name, rows in fields.items()}


@dataclass
class _Edge:
    """How one predicate is met and crossed: parameters [k] -> a change of the state."""

    apply: Callable[[np.ndarray], None]
    inside: Callable[[], np.ndarray]
    borders: Callable[[], Iterator[np.ndarray]]


class GoalStates:
    """Builds states of one task around its goal.

    Args:
        problem: the task.
        simulation: its scene, with contact sensors for its goal; fixtures stand where they shall.
        start: a start state of the task, qpos [nq].
        rng: the only source of randomness.
    """

    def __init__(self, problem: Problem, simulation: Simulation, start: np.ndarray, rng: np.random.Generator) -> None:
        self.problem, self.sim, self.rng = problem, simulation, rng
        self.qpos = start.copy()
        table = goals.build_table([problem], simulation.scene, [0])
        self.rows = [goals.GoalTable(*(field[:, [i]] for field in table)) for i in range(table.kind.shape[1])]

    def solve(self) -> np.ndarray:
        """A state in which every predicate holds (contacts may fail where a region is out of reach), qpos [nq]."""
        for index in self._order():
            edge = self._edge(index)
            for _ in range(_TRIES):
                edge.apply(edge.inside())
                if self._holds(index):
                    break
        return self.qpos.copy()

    def edges(self) -> list[np.ndarray]:
        """States that differ from a solved one in a single predicate, at its borders."""
        states = []
        for index in self._order():
            for _ in range(2):
                solved = self.solve()
                for parameters in self._edge(index).borders():
                    self.qpos = solved.copy()
                    self._edge(index).apply(parameters)
                    states.append(self.qpos.copy())
        return states

    def scattered(self, count: int) -> list[np.ndarray]:
        """Solved states in which every object is moved by about a centimetre, half of them also turned."""
        states = []
        for index in range(count):
            state = self.solve()
            for entity in self.sim.scene.objects:
                address = self._address(entity.name)
                state[address : address + 3] += self.rng.normal(scale=0.01, size=3)
                if index % 2:
                    quat = self.rng.normal(size=4)
                    state[address + 3 : address + 7] = quat / np.linalg.norm(quat)
            states.append(state)
        return states

    # -- one predicate -------------------------------------------------------------------------------------------------

    def _order(self) -> list[int]:
        """Joints first, then supports before what stands on them."""
        subjects = [predicate.args[0] for predicate in self.problem.goal]

        def depth(index: int) -> int:
            predicate = self.problem.goal[index]
            if len(predicate.args) == 1:
                return 0
            support = self._owner(predicate.args[1])
            return 1 + max((depth(i) for i, s in enumerate(subjects) if s == support and i != index), default=0)

        return sorted(range(len(subjects)), key=depth)

    def _owner(self, name: str) -> str:
        region = self.sim.scene.regions.get(name)
        return name if region is None or region.parent is None else region.parent

    def _holds(self, index: int) -> bool:
        return bool(goals.evaluate(self.rows[index], **self.sim.reads([self.qpos]))[0])

    def _edge(self, index: int) -> _Edge:
        row, predicate = self.rows[index], self.problem.goal[index]
        kind = int(row.kind[0, 0])
        self.sim.load(self.qpos)
        if kind == goals.IN_REGION:
            return self._in_region(row, predicate)
        if kind == goals.ON_REGION:
            return self._on_region(row, predicate)
        if kind == goals.ON_OBJECT:
            return self._on_object(row, predicate)
        return self._joints(row)

    def _address(self, name: str) -> int:
        (joint,) = [j for j in self.sim.scene.entities[name].joints if self.sim.model.joint(j).type[0] == 0]
        return int(self.sim.model.joint(joint).qposadr[0])

    def _frame(self, row: goals.GoalTable) -> tuple[np.ndarray, np.ndarray]:
        site = int(row.site[0, 0])
        if site < 0:
            return np.asarray(row.zone_pos[0, 0]), np.asarray(row.zone_mat[0, 0])
        return self.sim.data.site_xpos[site].copy(), self.sim.data.site_xmat[site].reshape(3, 3).copy()

    def _put(self, name: str, pos: np.ndarray) -> None:
        address = self._address(name)
        self.qpos[address : address + 3] = pos

    def _in_region(self, row: goals.GoalTable, predicate: Predicate) -> _Edge:
        frame, mat = self._frame(row)
        extent = np.abs(mat @ row.size[0, 0])
        low, high = frame - extent - [0, 0, 0.01], frame + extent

        def inside() -> np.ndarray:
            return low + self.rng.uniform(0.1, 0.9, 3) * (high - low)

        def borders() -> Iterator[np.ndarray]:
            for axis, bound, step in itertools.product(range(3), (low, high), _BOTH_SIDES):
                pos = inside()
                pos[axis] = bound[axis] + step
                yield pos

        return _Edge(lambda pos: self._put(predicate.args[0], pos), inside, borders)

    def _on_region(self, row: goals.GoalTable, predicate: Predicate) -> _Edge:
        frame, mat = self._frame(row)
        size = row.size[0, 0]
        low, high = size[2] - 0.005, size[2] + 0.10
        touch = int(row.touch[0, 0])

        def apply(delta: np.ndarray) -> None:
            self._put(predicate.args[0], frame + mat.T @ delta)

        def resting(delta: np.ndarray) -> np.ndarray:
            return delta if touch < 0 else self._first_touch(apply, delta, touch, float(low), float(high))

        def drawn() -> np.ndarray:
            return np.append(self.rng.uniform(-0.9, 0.9, 2) * size[:2], self.rng.uniform(low, high))

        def inside() -> np.ndarray:
            return resting(drawn())

        def borders() -> Iterator[np.ndarray]:
            for axis, sign, step in itertools.product(range(2), (-1, 1), _BOTH_SIDES):
                delta = drawn()
                delta[axis] = sign * (size[axis] + step)
                yield resting(delta)
            for bound, step in itertools.product((low, high), _BOTH_SIDES):
                yield np.append(drawn()[:2], bound + step)
            if touch >= 0:
                yield from self._around_touch(inside)

        return _Edge(apply, inside, borders)

    def _on_object(self, row: goals.GoalTable, predicate: Predicate) -> _Edge:
        reference = self.sim.data.xpos[int(row.reference[0, 0])].copy()
        touch = int(row.touch[0, 0])

        def apply(offset: np.ndarray) -> None:
            self._put(predicate.args[0], reference + offset)

        def at(radius: float) -> np.ndarray:
            angle = self.rng.uniform(0, 2 * np.pi)
            offset = np.array([radius * np.cos(angle), radius * np.sin(angle), 0.0])
            return self._first_touch(apply, offset, touch, 0.0, 0.2)

        def inside() -> np.ndarray:
            return at(0.027 * self.rng.random())

        def borders() -> Iterator[np.ndarray]:
            for step in _BOTH_SIDES:
                yield at(goals.ON_TOP_RADIUS + step)
                yield np.append(self.rng.uniform(-0.01, 0.01, 2), step)
            yield from self._around_touch(inside)

        return _Edge(apply, inside, borders)

    def _joints(self, row: goals.GoalTable) -> _Edge:
        addresses = row.joint[0, 0][row.joint_used[0, 0]]
        sign, bound = float(row.joint_sign[0, 0, 0]), float(row.joint_bound[0, 0, 0])

        def apply(values: np.ndarray) -> None:
            self.qpos[addresses] = values

        def inside() -> np.ndarray:
            return sign * np.full(len(addresses), bound + 0.01)

        def borders() -> Iterator[np.ndarray]:
            outside = sign * np.full(len(addresses), bound - 0.01)
            for step, base in itertools.product([0.0, *_BOTH_SIDES], (inside(), outside)):
                for joint in range(len(addresses)):
                    values = base.copy()
                    values[joint] = sign * (bound + step)
                    yield values

        return _Edge(apply, inside, borders)

    # -- contact -------------------------------------------------------------------------------------------------------

    def _around_touch(self, inside: Callable[[], np.ndarray]) -> Iterator[np.ndarray]:
        for step in (*_BOTH_SIDES, 1e-3, -1e-3):
            yield inside() + [0.0, 0.0, step]

    def _first_touch(
        self, apply: Callable[[np.ndarray], None], offset: np.ndarray, touch: int, low: float, high: float
    ) -> np.ndarray:
        """``offset`` with its third number lowered from ``high`` until contact begins; as it was where none begins."""

        def touching(height: float) -> bool:
            apply(np.append(offset[:2], height))
            self.sim.load(self.qpos)
            return bool(self.sim.data.sensordata[touch] > 0)

        for height in np.arange(high, low, -_SCAN):
            if touching(height):
                break
        else:
            return offset
        yes, no = height, height + _SCAN
        for _ in range(25):
            middle = (yes + no) / 2
            yes, no = (middle, no) if touching(middle) else (yes, middle)
        return np.append(offset[:2], yes)
