"""What published contacts cost on native physics, part by part.

MuJoCo alone steps the same batch through the same states, a control tick at a time, with models that differ in one part
of published contacts: our colliders, the solver's tolerances, or one point between convex shapes. Beside it two batches
of vecenv, one with published and one with current contacts, go their own ways. All take turns tick by tick.

    python benchmarks/contacts_cost.py --scene libero_object/0
    vecenv compile --out published; vecenv compile --out current --contacts current
    python benchmarks/contacts_cost.py --scenes published current        # where LIBERO's packages are not installed
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import mujoco
import numpy as np
from common import report
from mujoco.batch import Batch
from vecenv_eval.bench.physics import random_actions

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.scene.contacts import MESH_MARGIN, OPTIONS, mark
from vecenv.util.cores import usable_cores

BATCH = 64
OWN = ("published, own way", "current, own way")


def main() -> None:
    """Measure every scene; a row each, ratios first."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", default=["libero_object/0", "libero_spatial/0", "libero_10/2"])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=3.0, help="of each side a round")
    parser.add_argument("--scenes", nargs=2, default=[None, None], help="folders with published and current contacts")
    parser.add_argument("--name", default="contacts_cost", help="name of the results file")
    options = parser.parse_args()
    rows = []
    for scene in options.scene:
        rounds = [measure(scene, options.seconds, options.scenes) for _ in range(options.rounds)]
        rows.append({"scene": scene, **ratios(rounds)})
        print(rows[-1], flush=True)
    report(options.name, rows, title="Cost of published contacts", notes={"cores used": usable_cores(), "B": BATCH})


def ratios(rounds: list[dict[str, float]]) -> dict[str, Any]:
    """Medians over the rounds, and their range: published over current, then each variant over published."""
    row: dict[str, Any] = {}

    def add(name: str, one: str, other: str) -> None:
        found = sorted(rates[one] / rates[other] for rates in rounds)
        row[name], row[f"{name}, range"] = round(median(found), 3), f"{found[0]:.2f} to {found[-1]:.2f}"

    add("published / current, own ways", *OWN)
    add("published / current, same states", "published", "current")
    for name in rounds[0]:
        if name not in (*OWN, "published"):
            add(f"{name} / published", name, "published")
    return row | {f"{name} steps/s": round(median(rates[name] for rates in rounds)) for name in rounds[0]}


def variants(model: mujoco.MjModel) -> dict[str, mujoco.MjModel]:
    """Copies of a model with published contacts, each with one part as it is in current ones."""

    def colliders(changed: mujoco.MjModel) -> None:
        changed.numeric_data[0] = 0

    def tolerances(changed: mujoco.MjModel) -> None:
        for name in ("tolerance", "ls_tolerance"):
            setattr(changed.opt, name, OPTIONS["current"][name])

    def convex(changed: mujoco.MjModel) -> None:
        changed.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
        changed.opt.ccd_iterations = OPTIONS["current"]["ccd_iterations"]
        changed.geom_margin[changed.geom_margin == MESH_MARGIN] = 0

    changes: dict[str, Callable[[mujoco.MjModel], None]] = {
        "published": lambda changed: None,
        "MuJoCo's colliders": colliders,
        "current tolerances": tolerances,
        "convex shapes as now": convex,
        "current": lambda changed: mark(changed, "current"),
    }
    found = {name: copy.copy(model) for name in changes}
    for name, change in changes.items():
        change(found[name])
    return found


def measure(scene: str, seconds: float, scenes: list[str | None]) -> dict[str, float]:
    """Control steps a second of every side in one round."""
    suite, task = scene.rsplit("/", 1)
    envs = []
    for contacts, folder in zip(("published", "current"), scenes, strict=True):
        env = vecenv.make(
            suite,
            tasks=[int(task)] * 2,
            episodes=range(BATCH // 2),
            start="raw",
            settle_steps=0,
            max_steps=1_000_000,
            contacts=contacts,
            scenes=folder,
        )
        assert isinstance(env, LiberoEnv)
        env.reset()
        for tick in range(10):
            env.step_continuous(random_actions(BATCH, tick))
        envs.append(env)
    group = envs[0].physics.groups[0]
    batches = {}
    for name, model in variants(group.scene.model).items():
        batches[name] = Batch(model, BATCH, usable_cores(), persistent=True)
        for field in ("body_pos", "body_quat") if group.scene.fixtures else ():
            batches[name].expand(field)[:] = group.expand(field)
    spent = dict.fromkeys((*batches, *OWN), 0.0)
    ticks, names = 0, list(spent)
    while sum(spent.values()) < seconds * len(spent):
        actions, state = random_actions(BATCH, ticks), group.state
        for name in np.roll(names, -ticks).tolist():
            if name in batches:
                batches[name].state[:] = state
            begin = time.perf_counter()
            if name in batches:
                batches[name].step(nstep=25)
            else:
                envs[OWN.index(name)].step_continuous(actions)
            spent[name] += time.perf_counter() - begin
        ticks += 1
    for env in envs:
        env.close()
    return {name: ticks * BATCH / value for name, value in spent.items()}


if __name__ == "__main__":
    main()
