"""Images and tables of docs/geometry.md: exact and lean collision geometry on top of each other, and what it changes.

    MUJOCO_GL=osmesa python scripts/geometry_pictures.py pictures   # docs/geometry/*.png and the table of categories
    python scripts/geometry_pictures.py scenes                      # geoms, pairs and drift of all 32 scenes
    python scripts/geometry_pictures.py policy --episodes 10        # pick_place in closed loop, and replayed

Each run replaces its own part of the page, between two comments that name it. Images need a GL that MuJoCo can use
(``egl``, ``osmesa`` or ``glfw``) and Pillow.
"""

from __future__ import annotations

import argparse
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import mujoco
import numpy as np
from vecenv_eval.policies import make_policy

from vecenv import make
from vecenv.libero.env import SETTLE_ACTION, LiberoEnv
from vecenv.libero.scene import goals
from vecenv.libero.scene.bddl import SceneKey
from vecenv.libero.scene.lean import geometry, recipes
from vecenv.libero.scene.lean import solids as shapes
from vecenv.libero.scene.lean.solids import Solid
from vecenv.libero.scene.scene import Scene, scene_source
from vecenv.libero.tasks import suites

PAGE = Path(__file__).parent.parent / "docs" / "geometry.md"
PICTURES = PAGE.with_suffix("")
PANEL = 220
EXACT_COLOUR, LEAN_COLOUR = (0.2, 0.3, 0.7), (1.0, 0.5, 0.1)
MILLIMETRES = 1e3
IDLE_TICKS = 50
DRIFT_EPISODES = (0, 7, 13, 22, 41)
MAX_STEPS = 500
# Contacts that MJX reserves for a pair.
CONTACTS = {"plane-box": 4, "box-box": 4, "capsule-box": 2, "plane-capsule": 2, "capsule-capsule": 1}
_TYPES = {
    shapes.BOX: mujoco.mjtGeom.mjGEOM_BOX,
    shapes.CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE,
    shapes.CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER,
}
# Solids and their colour, RGBA.
_Group: TypeAlias = tuple[Sequence[Solid], tuple[float, ...]]
# Contents of the images, so that every part of a recipe is shown once.
_DRAWERS = {"top": {"filled", "worked"}, "middle": {"worked"}}
_EVERYTHING = frozenset({"held", "bears", "filled:region", "worked:"})
_OF_CABINETS = frozenset(f"{what}:{name}_region" for name, asked in _DRAWERS.items() for what in asked)


# Categories whose file has y up, and the rotation that stands them up.
_LYING = {"alphabet_soup", "ketchup", "milk", "new_salad_dressing", "orange_juice", "salad_dressing", "tomato_sauce"}
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def main() -> None:
    """Make what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("pictures", "scenes", "policy"))
    parser.add_argument("--episodes", type=int, default=10, help="of each task, for policy (libero_90: a fifth)")
    arguments = parser.parse_args()
    if arguments.what == "pictures":
        write_part("categories", pictures())
    elif arguments.what == "scenes":
        write_part("scenes", scene_table())
    else:
        write_part("policy", policy_table(arguments.episodes))


def write_part(name: str, lines: Iterable[str]) -> None:
    """Replace the part of the page between its two comments."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    text = PAGE.read_text()
    if begin not in text or end not in text:
        raise SystemExit(f"{PAGE}: no part {begin} ... {end}")
    part = "\n".join([begin, *lines, end])
    PAGE.write_text(re.sub(f"{re.escape(begin)}.*?{re.escape(end)}", lambda _: part, text, flags=re.DOTALL))


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Markdown lines of a table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(str(cell) for cell in line) + " |" for line in lines]


# -- scenes ------------------------------------------------------------------------------------------------------------


def scenes() -> dict[SceneKey, list[suites.TaskSpec]]:
    """Every scene of the 130 tasks, with its tasks."""
    found: dict[SceneKey, list[suites.TaskSpec]] = {}
    for suite in suites.BASE_SUITES:
        for task in suites.list_tasks(suite):
            found.setdefault(task.problem().scene_key(), []).append(task)
    return found


def compiled(tasks: Sequence[suites.TaskSpec]) -> tuple[Scene, Scene]:
    """The scene of some tasks, exact and lean for all of them that are of the first one's suite."""
    problems = [task.problem() for task in tasks if task.suite == tasks[0].suite]
    source = scene_source(problems[0], contact_pairs=goals.contact_pairs(problems))
    exact = source.compile()
    return exact, geometry.lean_scene(source, geometry.demands(problems), exact)


def colliding(model: mujoco.MjModel) -> list[int]:
    """Ids of the collision geoms."""
    return [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]


def pairs(model: mujoco.MjModel) -> Counter[str]:
    """How many pairs of geoms could collide, by their types: what MJX evaluates."""
    found: Counter[str] = Counter()
    weld, parent = model.body_weldid, model.body_weldid[model.body_parentid[model.body_weldid]]
    for first, second in itertools.combinations(colliding(model), 2):
        a, b = model.geom_bodyid[first], model.geom_bodyid[second]
        match = model.geom_contype[first] & model.geom_conaffinity[second]
        match |= model.geom_contype[second] & model.geom_conaffinity[first]
        related = weld[a] and weld[b] and (weld[a] == parent[b] or weld[b] == parent[a])
        if match and weld[a] != weld[b] and not related:
            kinds = sorted((int(model.geom_type[first]), int(model.geom_type[second])))
            found["-".join(mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in kinds)] += 1
    return found


def scene_table() -> list[str]:
    """Geoms, pairs and drift of every scene."""
    drifts = {profile: drift(profile) for profile in geometry.PROFILES}
    rows = []
    for key, tasks in scenes().items():
        exact, lean = compiled(tasks)
        before, after = pairs(exact.model), pairs(lean.model)
        rows.append(
            (
                f"{tasks[0].suite}/{tasks[0].index}",
                f"{len(colliding(exact.model))} → {len(colliding(lean.model))}",
                f"{before.total():,} → {after.total()}",
                f"{before['box-box']:,} → {after['box-box']}",
                sum(CONTACTS[kind] * count for kind, count in after.items()),
                *(summary(drifts[profile][key]) for profile in geometry.PROFILES),
            )
        )
        print(rows[-1], flush=True)
    rows.append(("all", "", "", "", "", *(summary(np.concatenate(list(d.values()))) for d in drifts.values())))
    header = ("scene", "geoms", "pairs", "box-box pairs", "contacts, at most", "drift exact, mm", "drift lean, mm")
    return table(header, rows)


def summary(moved: np.ndarray) -> str:
    """Median, 90th percentile and maximum of distances in metres, in millimetres."""
    values = MILLIMETRES * np.array([np.median(moved), np.quantile(moved, 0.9), moved.max()])
    return " / ".join(f"{value:.2f}" for value in values)


def drift(profile: str) -> dict[SceneKey, np.ndarray]:
    """How far each movable object of each settled start moves in 50 idle control steps, metres, by scene."""
    found: dict[SceneKey, list[np.ndarray]] = {}
    for suite in suites.BASE_SUITES:
        env = make(suite, episodes=DRIFT_EPISODES, geometry=profile)
        assert isinstance(env, LiberoEnv)
        env.reset()
        before = positions(env)
        env.step_continuous(np.tile(SETTLE_ACTION, (env.num_envs, IDLE_TICKS, 1)))
        keys = [task.problem().scene_key() for task in suites.list_tasks(suite)]
        for task, old, new in zip(env.evaluate().task_id, before, positions(env), strict=True):
            found.setdefault(keys[task], []).append(np.linalg.norm(new - old, axis=1))
        env.close()
    return {key: np.concatenate(parts) for key, parts in found.items()}


def positions(env: LiberoEnv) -> list[np.ndarray]:
    """Of each slot, where its movable objects are, [objects, 3]."""
    found, qpos = [], env.state().qpos
    for slot, index in enumerate(env.scene_index):
        model = env.mj_models[index]
        free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        found.append(np.array([qpos[slot, address : address + 3] for address in model.jnt_qposadr[free]]))
    return found


# -- policy ------------------------------------------------------------------------------------------------------------


def policy_table(episodes: int) -> list[str]:
    """How often pick_place solves the tasks: exact, lean, and what it did in exact repeated in lean."""
    rows = []
    for suite in suites.BASE_SUITES:
        count = max(1, episodes // 5) if suite == "libero_90" else episodes
        exact, actions = rollout(suite, count, "exact")
        lean, _ = rollout(suite, count, "lean")
        again = replay(suite, count, actions)
        same = (exact == lean).mean()
        rows.append(
            (suite, len(exact), *(f"{100 * part.mean():.1f} %" for part in (exact, lean, again)), f"{100 * same:.1f} %")
        )
        print(rows[-1], flush=True)
    header = ("suite", "episodes", "exact", "lean", "lean, exact's actions replayed", "same verdict exact and lean")
    return table(header, rows)


def rollout(suite: str, episodes: int, profile: str) -> tuple[np.ndarray, np.ndarray]:
    """Verdicts of pick_place, bool [B], and its actions, [ticks, B, 7]."""
    env = make(suite, episodes=range(episodes), max_steps=MAX_STEPS, geometry=profile)
    policy, info = make_policy("pick_place"), env.reset()
    actions: list[np.ndarray] = []
    with env.watched(lambda action, _: actions.append(action.copy())):
        policy.reset(env, info)
        for _ in range(MAX_STEPS):
            if env.evaluate().success.all():
                break
            chosen = policy.act(env)
            assert isinstance(chosen, np.ndarray)
            env.step_continuous(chosen)
    success = env.evaluate().success
    env.close()
    return success, np.array(actions)


def replay(suite: str, episodes: int, actions: np.ndarray) -> np.ndarray:
    """Verdicts of the same actions in the lean scenes, bool [B]."""
    env = make(suite, episodes=range(episodes), max_steps=MAX_STEPS, geometry="lean")
    env.reset()
    for action in actions:
        env.step_continuous(action)
    success = env.evaluate().success
    env.close()
    return success


# -- images ------------------------------------------------------------------------------------------------------------


def pictures() -> list[str]:
    """Draw every category and the robot; the table of categories."""
    PICTURES.mkdir(exist_ok=True)
    rows, seen = [], set()
    for tasks in scenes().values():
        scene, _ = compiled(tasks)
        if not seen:
            rows += robot_rows(scene)
        for entity in scene.entities.values():
            if entity.category not in seen:
                seen.add(entity.category)
                rows.append(category_row(scene, entity.name))
    header = ("category", "geoms", "bystander", "needed", "finest", "exact; finest, needed and bystander over it")
    return table(header, sorted(rows))


def category_row(scene: Scene, name: str) -> tuple[str, ...]:
    """Draw a thing; its row of the table."""
    entity = scene.entities[name]
    exact = [
        placed(scene, int(scene.model.geom_bodyid[g]), geometry.solid_of(scene.model, g))
        for g in geometry.entity_geoms(scene.model, entity)
    ]
    levels = [lean_levels(scene, name, len(exact), which) for which in ("bystander", "needed", "finest")]
    turn = _Y_UP if entity.category in _LYING else np.eye(3)
    upright = [[solid.turned(turn) for solid in solids] for solids in (exact, *reversed(levels))]
    save(entity.category, upright)
    cells = (described(exact, level) for level in levels)
    return entity.category, str(len(exact)), *cells, f"![{entity.category}](geometry/{entity.category}.png)"


def robot_rows(scene: Scene) -> Iterator[tuple[str, ...]]:
    """Draw the robot's hand and the links of its arm that collide; their rows of the table."""
    for name, parts in (("robot_hand", recipes.ROBOT_HAND), ("robot_arm", recipes.ROBOT_ARM[-1])):
        made = [geometry.fit_part(scene, geometry.ROBOT, part) for part in parts]
        geoms = [
            (part.body, g) for part in made for g in colliding(scene.model) if scene.model.geom_bodyid[g] == part.body
        ]
        exact = [placed(scene, body, geometry.solid_of(scene.model, g)) for body, g in geoms]
        lean = [placed(scene, part.body, solid) for part in made for solid in part.solids]
        save(name, [exact, lean], azimuth=75.0)
        least = str(len(lean)) if parts is recipes.ROBOT_HAND else "0"
        yield name, str(len(exact)), least, least, str(len(lean)), f"![{name}](geometry/{name}.png)"


def lean_levels(scene: Scene, name: str, solids: int, which: str) -> list[Solid]:
    """A thing's lean geoms at one level of detail, world frame."""
    category = scene.entities[name].category
    asked = frozenset() if which == "bystander" else _EVERYTHING | _OF_CABINETS
    modules = recipes.recipe(category, solids).modules(asked)
    parts = [part for m in modules for part in m.levels[-1 if which == "finest" else m.wanted]]
    made = [geometry.fit_part(scene, name, part) for part in parts]
    return [placed(scene, part.body, solid) for part in made for solid in part.solids]


def described(exact: Sequence[Solid], lean: Sequence[Solid]) -> str:
    """Number of geoms, and mean distances of the exact surface from the lean one and back, millimetres."""
    if not lean:
        return "0"
    there, back = (MILLIMETRES * shapes.gaps(*pair).mean() for pair in ((exact, lean), (lean, exact)))
    return f"{len(lean)} ({there:.1f}, {back:.1f})"


def placed(scene: Scene, body: int, solid: Solid) -> Solid:
    """A solid of a body in the world frame, joints at their reference."""
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    turn, shift = data.xmat[body].reshape(3, 3), data.xpos[body]
    points = None if solid.points is None else solid.points @ turn.T + shift
    return Solid(solid.kind, turn @ solid.pos + shift, turn @ solid.mat, solid.size, points)


def save(name: str, shapes: Sequence[Sequence[Solid]], azimuth: float = 130.0) -> None:
    """An image with one panel per shape: the first alone, the others each with the first over it."""
    from PIL import Image

    exact, *others = shapes
    panels = [drawn([(exact, (*EXACT_COLOUR, 1.0))], exact, azimuth)]
    panels += [drawn([(lean, (*LEAN_COLOUR, 0.55)), (exact, (*EXACT_COLOUR, 0.35))], exact, azimuth) for lean in others]
    Image.fromarray(np.concatenate(panels, axis=1)).quantize(64).save(PICTURES / f"{name}.png", optimize=True)


def drawn(groups: Sequence[_Group], around: Sequence[Solid], azimuth: float) -> np.ndarray:
    """Solids in their colours, looking down on them from an azimuth (degrees), [PANEL, PANEL, 3]."""
    model = _model(groups)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    points = np.concatenate([solid.extreme_points() for solid in around])
    camera = mujoco.MjvCamera()
    camera.lookat = (points.min(axis=0) + points.max(axis=0)) / 2
    camera.distance = 1.45 * float(np.linalg.norm(np.ptp(points, axis=0)))
    camera.azimuth, camera.elevation = azimuth, -30.0
    with mujoco.Renderer(model, PANEL, PANEL) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render().copy()


def _model(groups: Sequence[_Group]) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.visual.headlight.ambient = [0.5, 0.5, 0.5]
    sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_FLAT}
    spec.add_texture(name="sky", rgb1=[1, 1, 1], rgb2=[1, 1, 1], width=16, height=16, **sky)
    for solids, colour in groups:
        for solid in solids:
            geom = spec.worldbody.add_geom(rgba=colour)
            if solid.points is not None:
                mesh = spec.add_mesh(name=f"mesh{len(spec.meshes)}")
                mesh.uservert = solid.points.astype(np.float32).ravel()
                geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name
                continue
            geom.type, geom.pos, geom.size = _TYPES[solid.kind], solid.pos, solid.size
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, solid.mat.ravel())
            geom.quat = quat
    return spec.compile()


if __name__ == "__main__":
    main()
