"""Write ``tests/simpler_published_upstream.json``: upstream's evaluation lists, and where episodes of them begin.

Upstream's shell scripts are run with a ``python`` that only notes its arguments; upstream's own parser and evaluation
loop turn those into episodes, which are counted, hashed and sampled. Of a sample, upstream's environments are reset on
SAPIEN 2.2.2, without a renderer: poses in which objects are dropped and in which they come to rest, base, joints,
drawers and instruction.

    PYTHON scripts/simpler_published_upstream.py SIMPLER_ENV MANISKILL2 [--out FILE]

PYTHON has sapien 2.2.2, numpy 1.26, gymnasium 0.29, transforms3d, ruckig, trimesh, opencv-python-headless, h5py,
imageio. SIMPLER_ENV is a checkout of SimplerEnv (4ab7178), MANISKILL2 one of ManiSkill2_real2sim (ef7a4d4); the script
writes stand-ins for missing meshes into it: tables as high as vecenv's, anything for rooms, which nothing touches.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib
import io
import json
import os
import random
import shutil
import stat
import subprocess
import sys
import tempfile
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

MATCHING, AGGREGATION = "visual-matching", "variant-aggregation"
SUFFIXES = {MATCHING: "visual_matching", AGGREGATION: "variant_agg"}
ORIENTATIONS = {"": "", "horizontal_": "lr_switch", "vertical_": "laid_vertically", "standing_": "upright"}
DRAWERS = ("", "top", "middle", "bottom")
BRIDGE = {
    "widowx_spoon_on_towel": "PutSpoon",
    "widowx_carrot_on_plate": "PutCarrot",
    "widowx_stack_cube": "StackGreen",
    "widowx_put_eggplant_in_basket": "PutEggplant",
}
# Task -> environment, and how many resets in a row.
PREPACKAGED = {
    "google_robot_pick_object": ("GraspSingleRandomObjectInScene-v0", 10),
    "google_robot_place_in_closed_drawer": ("PlaceIntoClosedDrawerCustomInScene-v0", 5),
    "google_robot_place_in_closed_bottom_drawer": ("PlaceIntoClosedBottomDrawerCustomInScene-v0", 2),
}
AT_MOST = 7
# Their tables differ from every stand-in, so nothing is dropped on them.
UNKNOWN_TABLES = ("Baked_sc1", "alt_background")
# Name -> offset of the scene, height of the top, lower and upper xy; metres.
TABLES = {
    "bridge_table_1_v1": ((-2.0634, -2.8313, 0.0), 0.869532, (-0.7, -0.6), (0.3, 0.6)),
    "bridge_table_1_v2": ((-2.0634, -2.8313, 0.0), 0.869532, (-0.7, -0.6), (0.3, 0.6)),
    "google_pick_coke_can_1_v4": ((-1.6616, -3.0337, 0.0), 0.887532, (-0.7, -0.5), (0.05, 0.9)),
}
ROOMS = ("frl_apartment_stage_simple", "modern_bedroom_no_roof", "modern_office_no_roof")
BARE = ("eggplant", "blue_plastic_bottle", "opened_redbull_can", "redbull_can", "baked_opened_redbull_can")
DROPPED_ABOVE = 1.36


# ---------------------------------------------------------------------------------------------------------------------
# Upstream without a renderer.


def fill_in(tree: Path) -> None:
    """Stand-ins for missing meshes."""
    import trimesh

    stages = tree / "data/hab2_bench_assets/stages"
    stages.mkdir(parents=True, exist_ok=True)
    upright = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    for name, (offset, top, low, high) in {**TABLES, **dict.fromkeys(ROOMS, TABLES["bridge_table_1_v1"])}.items():
        if not (stages / f"{name}.glb").exists():
            low_corner, high_corner = np.array([*low, top - 0.1]), np.array([*high, top])
            box = trimesh.creation.box(high_corner - low_corner)
            box.apply_translation((low_corner + high_corner) / 2 + np.array(offset))
            box.apply_transform(upright)
            box.export(stages / f"{name}.glb")
    for name in BARE:
        folder = tree / "data/custom/models" / name
        if not list(folder.glob("textured.*")):
            shutil.copy(folder / "collision.obj", folder / "textured.obj")


def upstream(simpler_env: Path, maniskill: Path) -> types.SimpleNamespace:
    """Upstream's modules, with the renderer, cameras and lights taken out."""
    sys.path[:0] = [str(simpler_env), str(maniskill)]
    os.environ["MS2_REAL2SIM_ASSET_DIR"] = str(maniskill / "data")
    core: Any = importlib.import_module("sapien.core")
    real = core.Engine
    core.Engine = lambda: _Engine(real())
    core.SapienRenderer = lambda **_: types.SimpleNamespace(set_log_level=lambda _: None)
    scenes: Any = importlib.import_module("mani_skill2_real2sim.envs.custom_scenes.base_env")
    scenes.set_articulation_render_material = lambda *_, **__: None
    importlib.import_module("mani_skill2_real2sim.envs.sapien_env").BaseEnv._setup_cameras = lambda _: None
    for kind in ("grasp_single", "move_near", "open_drawer", "place_in_closed_drawer", "put_on"):
        module = importlib.import_module(f"mani_skill2_real2sim.envs.custom_scenes.{kind}_in_scene")
        for each in vars(module).values():
            if isinstance(each, type) and "_setup_lighting" in vars(each):
                each._setup_lighting = lambda _: None  # type: ignore[attr-defined]
    for absent in ("mediapy", "matplotlib", "matplotlib.pyplot"):
        sys.modules.setdefault(absent, types.ModuleType(absent))
    films: Any = types.ModuleType("simpler_env.utils.visualization")
    films.write_video = None
    sys.modules[films.__name__] = films
    return types.SimpleNamespace(
        gym=importlib.import_module("gymnasium"),
        scenes=scenes,
        parser=importlib.import_module("simpler_env.evaluation.argparse"),
        loop=importlib.import_module("simpler_env.evaluation.maniskill2_evaluator"),
    )


class _Engine:
    """SAPIEN's engine that is never given a renderer."""

    def __init__(self, engine: Any) -> None:
        self._engine = engine

    def set_renderer(self, _: Any) -> None:
        """Leave it without."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)


# ---------------------------------------------------------------------------------------------------------------------
# Lists.


def commands(simpler_env: Path, script: str) -> list[list[str]]:
    """Arguments of every Python command of a shell script."""
    with tempfile.TemporaryDirectory() as folder:
        log, fake = Path(folder) / "log", Path(folder) / "python"
        note = "import json, sys; open(sys.argv[1], 'a').write(json.dumps(sys.argv[2:]) + chr(10))"
        fake.write_text(f'#!/bin/sh\nexec "{sys.executable}" -c "{note}" "{log}" "$@"\n')
        fake.chmod(fake.stat().st_mode | stat.S_IEXEC)
        environment = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"}
        subprocess.run(
            ["bash", f"scripts/{script}.sh"], cwd=simpler_env, env=environment, check=True, capture_output=True
        )
        return [json.loads(line) for line in log.read_text().splitlines()]


def episodes(peer: types.SimpleNamespace, simpler_env: Path, script: str) -> list[dict[str, Any]]:
    """What the loop runs for the first checkpoint of a script, keyword arguments of every episode."""
    found: list[dict[str, Any]] = []
    peer.loop.run_maniskill2_eval_single_episode = lambda **given: bool(found.append(given))
    first = None
    for arguments in commands(simpler_env, script):
        sys.argv = arguments
        with contextlib.redirect_stdout(io.StringIO()):
            parsed = peer.parser.get_args()
            first = first or (parsed.policy_model, parsed.ckpt_path)
            if (parsed.policy_model, parsed.ckpt_path) == first:
                peer.loop.maniskill2_evaluator(None, parsed)
    return found


def lists(peer: types.SimpleNamespace, simpler_env: Path) -> Iterator[tuple[str, str, list[dict[str, Any]]]]:
    """Protocol, task, episodes."""
    bridge = episodes(peer, simpler_env, "rt1x_bridge")
    for task, prefix in BRIDGE.items():
        yield MATCHING, task, [each for each in bridge if each["env_name"].startswith(prefix)]
    for protocol, suffix in SUFFIXES.items():
        cans = episodes(peer, simpler_env, f"rt1_pick_coke_can_{suffix}")
        for name, lies in ORIENTATIONS.items():
            some = [each for each in cans if not lies or each["additional_env_build_kwargs"].get(lies)]
            yield protocol, f"google_robot_pick_{name}coke_can", some
        yield protocol, "google_robot_move_near_v0", episodes(peer, simpler_env, f"rt1_move_near_{suffix}")
        drawers = episodes(peer, simpler_env, f"rt1_drawer_{suffix}")
        for verb in ("open", "close"):
            for which in DRAWERS:
                prefix = f"{verb.capitalize()}{which.capitalize()}"
                some = [each for each in drawers if each["env_name"].startswith(prefix)]
                yield protocol, f"google_robot_{verb}_{which}{'_' * bool(which)}drawer", some
        apples = episodes(peer, simpler_env, f"rt1_put_in_drawer_{suffix}")
        yield protocol, "google_robot_place_apple_in_closed_top_drawer", apples


def row(given: dict[str, Any]) -> list[Any]:
    """An episode as the tests compare it."""
    kwargs = dict(given["additional_env_build_kwargs"] or {})
    if given["enable_raytracing"]:
        kwargs = {"shader_dir": "rt", **kwargs}
    bare = given.get("obj_init_x") is None or given["env_name"].startswith(("Open", "Close"))
    return [
        given["env_name"],
        given["robot_name"],
        given["scene_name"],
        rounded([given["robot_init_x"], given["robot_init_y"]]),
        signed(given["robot_init_quat"]),
        None if bare else rounded([given["obj_init_x"], given["obj_init_y"]]),
        given.get("obj_episode_id"),
        given["control_freq"],
        given["sim_freq"],
        given["max_episode_steps"],
        given["control_mode"],
        Path(given["rgb_overlay_path"] or "").name,
        [[name, str(value)] for name, value in kwargs.items()],
    ]


def rounded(values: Any) -> list[float]:
    """To a micrometre."""
    return [round(float(value), 6) + 0.0 for value in values]


def signed(quat: Any) -> list[float]:
    """Of a quaternion and its negative, the one that begins positive."""
    values = rounded(quat)
    leading = next((value for value in values if value), 1)
    return [(-value if leading < 0 else value) + 0.0 for value in values]


# ---------------------------------------------------------------------------------------------------------------------
# Where episodes begin.


class _Begun(Exception):
    """Carries the environment out of upstream's loop before it renders its first image."""


class Starts:
    """Resets upstream's environments and reads where everything is."""

    def __init__(self, peer: types.SimpleNamespace) -> None:
        self._peer = peer
        loop: Any = importlib.reload(peer.loop)
        self._run, loop.build_maniskill2_env = loop.run_maniskill2_eval_single_episode, self.build
        loop.get_image_from_maniskill2_obs_dict = _begun
        self._dropped: dict[str, Any] = {}
        settle, dropped = peer.scenes.CustomSceneEnv._settle, self._dropped

        def watched(env: Any, seconds: float) -> None:
            for actor in env._scene.get_all_actors():
                if actor.pose.p[2] > DROPPED_ABOVE:
                    dropped[actor.name] = [*rounded(actor.pose.p), *signed(actor.pose.q)]
            settle(env, seconds)

        peer.scenes.CustomSceneEnv._settle = watched

    def build(self, name: str, **given: Any) -> Any:
        """An environment without images."""
        for pictures in ("camera_cfgs", "rgb_overlay_path", "shader_dir"):
            given.pop(pictures, None)
        return self._peer.gym.make(name, **{**given, "obs_mode": "state_dict"})

    def of(self, given: dict[str, Any]) -> dict[str, Any]:
        """Of an episode of the loop."""
        with contextlib.redirect_stdout(io.StringIO()):
            try:
                self._run(**given)
            except _Begun as begun:
                return self.read(begun.args[0].unwrapped)
        raise RuntimeError("the loop rendered no image")

    def resets(self, name: str, count: int) -> list[dict[str, Any]]:
        """Of resets in a row."""
        env = self._peer.gym.make(name, obs_mode="state_dict", prepackaged_config=True)
        found = []
        for _ in range(count):
            env.reset()
            found.append(self.read(env.unwrapped))
        return found

    def read(self, env: Any) -> dict[str, Any]:
        """Poses as xyz and wxyz, world frame."""
        robot = env.agent.robot
        names = [actor.name for actor in env._scene.get_all_actors() if actor.name not in ("arena", "ground", "")]
        rest = {actor.name: actor.pose for actor in env._scene.get_all_actors()}
        return {
            "base": [*rounded(robot.pose.p), *signed(robot.pose.q)],
            "qpos": rounded(robot.get_qpos()),
            "dropped": {name: self._dropped.get(name) for name in names},
            "objects": {name: [*rounded(rest[name].p), *signed(rest[name].q)] for name in names},
            "drawers": rounded(env.art_obj.get_qpos()) if hasattr(env, "art_obj") else [],
            "instruction": env.get_language_instruction(),
        }


def _begun(env: Any, *_: Any, **__: Any) -> None:
    raise _Begun(env)


def sample(task: str, rows: list[dict[str, Any]], rng: random.Random) -> list[int]:
    """Some episodes of every setting or colour; nothing of tasks whose episodes another task has too."""
    if task.startswith("google_robot_pick_") and task != "google_robot_pick_coke_can":
        return []
    if "drawer" in task and any(which in task.split("_") for which in DRAWERS[1:]) and "apple" not in task:
        return []
    groups: dict[str, list[int]] = {}
    for index, given in enumerate(rows):
        if not any(name in given["scene_name"] for name in UNKNOWN_TABLES):
            kwargs = given["additional_env_build_kwargs"] or {}
            varied = {name: value for name, value in kwargs.items() if name not in ORIENTATIONS.values()}
            groups.setdefault(f"{given['env_name']} {given['scene_name']} {varied}", []).append(index)
    several = -(-AT_MOST // len(groups))
    return sorted(rng.sample([index for group in groups.values() for index in rng.sample(group, several)], AT_MOST))


def main() -> None:
    """Read the arguments, run upstream, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("simpler_env", type=Path)
    parser.add_argument("maniskill2", type=Path)
    parser.add_argument("--out", type=Path, default=Path("tests/simpler_published_upstream.json"))
    options = parser.parse_args()
    fill_in(options.maniskill2)
    peer = upstream(options.simpler_env.resolve(), options.maniskill2.resolve())
    read = list(lists(peer, options.simpler_env))
    counted = {}
    for protocol, task, given in read:
        rows = [row(each) for each in given]
        digest = hashlib.sha256(json.dumps(rows).encode()).hexdigest()
        shown = {index: rows[index] for index in sorted({0, len(rows) // 3, len(rows) - 1})}
        counted[f"{protocol}/{task}"] = {"count": len(rows), "digest": digest, "rows": shown}
    starts, rng, found = Starts(peer), random.Random(0), []
    for protocol, task, given in read:
        for index in sample(task, given, rng):
            found.append({"protocol": protocol, "task": task, "index": index, **starts.of(given[index])})
    for task, (name, count) in PREPACKAGED.items():
        for index, start in enumerate(starts.resets(name, count)):
            found.append({"protocol": MATCHING, "task": task, "index": index, **start})
    options.out.write_text(_text(counted, found))
    print(f"{len(counted)} lists, {len(found)} starts")


def _text(counted: dict[str, Any], found: list[dict[str, Any]]) -> str:
    """One line a list and a start."""
    lines = [f'"lists": {{\n{",".join(_line(name, each) for name, each in counted.items())}}}']
    lines.append(f'"starts": [\n{",".join(chr(10) + json.dumps(each) for each in found)}]')
    return "{" + ",\n".join(lines) + "}\n"


def _line(name: str, value: Any) -> str:
    return f"\n{json.dumps(name)}: {json.dumps(value)}"


if __name__ == "__main__":
    main()
