"""Twenty cluttered LIBERO scenes: tall things stand between the object, the hand and the goal; collisions are counted.

    python benchmarks/voxposer_clutter.py
    python benchmarks/voxposer_clutter.py --variants raised,straight --scenes 0-9

The scenes are tasks of libero_object and libero_goal whose tallest bystanders were moved by ``env.set_state``: a row of
them stands across the way from the object to its goal, or from the hand to the object (:data:`SCENES`). A row of the
table is a variant of VoxPoser (``voxposer_variants``) on all scenes:

* solved: episodes whose goal held.
* clean: solved, and no bystander was displaced by more than 2 cm.
* touching: control ticks, a scene, at which the robot or the object it carries touched a bystander or a fixture that is
  no goal.
* touched: bystanders and such fixtures touched, a scene.
* displaced: bystanders that ended more than 2 cm from where they stood, a scene.
* farthest: the largest displacement of one, in centimetres, averaged over the scenes.

Scenes with results are kept in the folder ``--work`` and not run again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from common import ROOT, report
from vecenv_eval.policies.voxposer import VoxPoserPolicy
from voxposer_variants import VARIANTS

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.scene.scene import Scene
from vecenv.observations import ObjectsSnapshot
from vecenv.placement import parse_tasks

# A bystander that ended this far from where it stood was displaced, metres.
DISPLACED = 0.02
# Room between neighbours in a row, and where others go that are in its way, metres.
GAP = 0.012
ASIDE = ((0.24, -0.30), (0.24, -0.16), (0.24, -0.02), (0.24, 0.12), (-0.30, -0.30), (-0.30, 0.30))
# Ticks in which moved objects come to rest.
REST = 20
_STAY = np.array([0.0, 0, 0, 0, 0, 0, -1])


@dataclass(frozen=True)
class Clutter:
    """One scene.

    Attributes:
        suite, task, episode: the episode whose start is changed.
        across: the row stands on the way from the object to its ``"goal"``, or to the ``"hand"``.
        distance: of the row from the object, metres.
        count: bystanders in the row, the tallest first.
    """

    suite: str
    task: int
    episode: int
    across: str
    distance: float
    count: int


SCENES = (
    *(Clutter("libero_object", task, 0, "goal", 0.13, 3) for task in range(10)),
    *(Clutter("libero_object", task, 1, "hand", 0.12, 2) for task in (0, 2, 4, 6, 7, 8)),
    *(Clutter("libero_goal", task, episode, "goal", 0.12, 1) for task in (1, 4) for episode in (0, 1)),
)


@dataclass
class Outcome:
    """What happened in a scene: the counts of the module's docstring, and each bystander's displacement in metres."""

    scene: int
    solved: bool
    steps: int
    touching: int
    touched: tuple[str, ...]
    displacement: dict[str, float]


class Contacts:
    """Watches a batch: at which ticks the robot or an object that is not to be touched meets something.

    Args:
        env: the batch, just reset.
        own: of each slot, names of the object that is carried and of the goal.
    """

    def __init__(self, env: LiberoEnv, own: Sequence[tuple[str, ...]]) -> None:
        self._env, self._own = env, own
        self._data = {id(model): mujoco.MjData(model) for model in env.mj_models}
        self._owners: dict[int, np.ndarray] = {}
        for group in env.physics.groups:
            self._owners[id(group.scene.model)] = owners(group.scene)
        self.ticks = np.zeros(env.num_envs, int)
        self.touched: list[set[str]] = [set() for _ in range(env.num_envs)]

    def __call__(self, actions: np.ndarray, active: np.ndarray) -> None:
        """Count the contacts of the present state in the slots that are about to move."""
        del actions
        state, index = self._env.state(), self._env.scene_index
        for slot in np.flatnonzero(active).tolist():
            met = self._met(self._env.mj_models[int(index[slot])], state.qpos[slot], self._own[slot])
            self.ticks[slot] += bool(met)
            self.touched[slot] |= met

    def _met(self, model: mujoco.MjModel, qpos: np.ndarray, own: tuple[str, ...]) -> set[str]:
        data, owner = self._data[id(model)], self._owners[id(model)]
        data.qpos[:] = qpos[: model.nq]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        carried, met = own[0], set[str]()
        for one, other in data.contact.geom[: data.ncon]:
            pair = {str(owner[one]), str(owner[other])}
            if pair & {"robot", carried}:
                met |= pair - {"robot", "", *own}
        return met


def owners(scene: Scene) -> np.ndarray:
    """Whose each geom is: ``"robot"``, the name of an object or fixture, "" for table and floor; object [ngeom]."""
    model = scene.model
    roots = {model.body(entity.root_body).id: name for name, entity in scene.entities.items()}
    names = np.array([""] * model.ngeom, dtype=object)
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        while body and body not in roots:
            if model.body(body).name.startswith(("robot0", "gripper0")):
                names[geom] = "robot"
                break
            body = int(model.body_parentid[body])
        else:
            names[geom] = roots.get(body, "")
    return names


def own_names(snapshot: ObjectsSnapshot) -> tuple[str, ...]:
    """The object of the goal that is carried, then the object or fixture it goes to."""
    _, carried, *places = snapshot.goal[0]
    regions = [snapshot.regions[place].parent for place in places if place in snapshot.regions]
    return (carried, *(name for name in (*places, *regions) if name))


def row_of(snapshot: ObjectsSnapshot, clutter: Clutter) -> dict[str, np.ndarray]:
    """Where the bystanders of a scene go: name -> xy [2], those that only make room included."""
    own = own_names(snapshot)
    start = snapshot.poses[own[0]][:2]
    end = snapshot.ee_pose[:2] if clutter.across == "hand" else _middle(snapshot, own[-1])
    ahead = (end - start) / np.linalg.norm(end - start)
    aside = np.array([-ahead[1], ahead[0]])
    height = {name: float(np.ptp(snapshot.objects[name].points[:, 2])) for name in snapshot.movable if name not in own}
    row = sorted(height, key=lambda name: -height[name])[: clutter.count]
    widths = [2 * _radius(snapshot, name) + GAP for name in row]
    at = np.cumsum(widths) - np.array(widths) / 2 - sum(widths) / 2
    placed = {name: start + clutter.distance * ahead + offset * aside for name, offset in zip(row, at, strict=True)}
    free = list(ASIDE)
    for name in height:
        if name not in placed and any(_crowds(snapshot, name, other, xy) for other, xy in placed.items()):
            placed[name] = np.array(free.pop(0))
    return placed


def _crowds(snapshot: ObjectsSnapshot, name: str, other: str, xy: np.ndarray) -> bool:
    apart = float(np.linalg.norm(_middle(snapshot, name) - xy))
    return apart < _radius(snapshot, name) + _radius(snapshot, other) + GAP


def _middle(snapshot: ObjectsSnapshot, name: str) -> np.ndarray:
    if name in snapshot.regions:
        return snapshot.regions[name].pos[:2]
    points = snapshot.objects[name].points
    return (points.min(axis=0) + points.max(axis=0))[:2] / 2


def _radius(snapshot: ObjectsSnapshot, name: str) -> float:
    points = snapshot.objects[name].points[:, :2]
    return float(np.linalg.norm(points - _middle(snapshot, name), axis=1).max())


def arrange(env: LiberoEnv, scenes: Sequence[Clutter]) -> None:
    """Move the bystanders of every slot to their places, and let them come to rest."""
    snapshots, state, index = env.observe_objects().snapshot, env.state(), env.scene_index
    for slot, clutter in enumerate(scenes):
        snapshot, scene = snapshots[slot], env.physics.groups[index[slot]].scene
        assert snapshot is not None
        for name, xy in row_of(snapshot, clutter).items():
            address = int(scene.model.joint(scene.entities[name].joints[0]).qposadr[0])
            shift = xy - _middle(snapshot, name)
            state.qpos[slot, address : address + 2] += shift
    env.set_state(state)
    env.step_continuous(np.tile(_STAY, (env.num_envs, REST, 1)))


def run(numbers: Sequence[int], variant: str) -> list[Outcome]:
    """Run scenes of one suite as one batch."""
    scenes = [SCENES[number] for number in numbers]
    tasks, episodes = [scene.task for scene in scenes], [scene.episode for scene in scenes]
    policy = VoxPoserPolicy(**VARIANTS[variant].options)
    with vecenv.make(scenes[0].suite, tasks=[0], episodes=list(range(len(scenes)))) as env:
        assert isinstance(env, LiberoEnv)
        env.set_episodes(tasks=tasks, episodes=episodes)
        info = env.reset()
        arrange(env, scenes)
        before = [snapshot for snapshot in env.observe_objects().snapshot if snapshot]
        own = [own_names(snapshot) for snapshot in before]
        contacts = Contacts(env, own)
        policy.reset(env, info)
        with env.watched(contacts):
            while not env.done.all():
                policy.act(env)
        after, metrics = env.observe_objects().snapshot, env.evaluate()
    return [
        Outcome(
            scene=number,
            solved=bool(metrics.success[i]),
            steps=int(metrics.num_steps[i]),
            touching=int(contacts.ticks[i]),
            touched=tuple(sorted(contacts.touched[i])),
            displacement=_displacement(before[i], after[i], own[i]),
        )
        for i, number in enumerate(numbers)
    ]


def _displacement(before: ObjectsSnapshot, after: ObjectsSnapshot | None, own: tuple[str, ...]) -> dict[str, float]:
    if after is None:
        return {}
    names = [name for name in before.movable if name not in own]
    return {name: round(float(np.linalg.norm((after.poses[name] - before.poses[name])[:3])), 4) for name in names}


def summary(variant: str, outcomes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The row of a variant."""
    moved = [[far for far in each["displacement"].values() if far > DISPLACED] for each in outcomes]
    farthest = [max(each["displacement"].values(), default=0.0) for each in outcomes]
    return {
        "variant": variant,
        "scenes": len(outcomes),
        "solved": sum(each["solved"] for each in outcomes),
        "clean": sum(each["solved"] and not far for each, far in zip(outcomes, moved, strict=True)),
        "touching": round(float(np.mean([each["touching"] for each in outcomes])), 1),
        "touched": round(float(np.mean([len(each["touched"]) for each in outcomes])), 2),
        "displaced": round(float(np.mean([len(far) for far in moved])), 2),
        "farthest": round(100 * float(np.mean(farthest)), 1),
        "steps": round(float(np.mean([each["steps"] for each in outcomes]))),
    }


def main() -> None:
    """Run the variants on the scenes that have no results yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variants", default="map,raised,raised-straight,planned,straight")
    parser.add_argument("--scenes", default="all")
    parser.add_argument("--work", type=Path, default=ROOT / "results" / "voxposer_clutter")
    options = parser.parse_args()
    unknown = [name for name in options.variants.split(",") if name not in VARIANTS]
    if unknown:
        parser.error(f"no variant {unknown[0]!r}; there are {', '.join(VARIANTS)}")
    wanted = parse_tasks(options.scenes, len(SCENES))
    options.work.mkdir(parents=True, exist_ok=True)
    rows, details = [], {}
    for variant in options.variants.split(","):
        path = options.work / f"{variant}.json"
        known: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
        for suite in dict.fromkeys(scene.suite for scene in SCENES):
            left = [n for n in wanted if str(n) not in known and SCENES[n].suite == suite]
            if left:
                known |= {str(outcome.scene): asdict(outcome) for outcome in run(left, variant)}
                path.write_text(json.dumps(known, indent=1) + "\n")
        details[variant] = [known[str(n)] for n in wanted]
        rows.append(summary(variant, details[variant]))
        notes = {"scenes": [asdict(scene) for scene in SCENES], "episodes": details}
        report("voxposer_clutter", rows, title="VoxPoser (offline/libero) among tall bystanders", notes=notes)


if __name__ == "__main__":
    main()
