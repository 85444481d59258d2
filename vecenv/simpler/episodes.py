"""From an episode's layout to what physics needs: the scene, the start, and the objects' roles.

In: a ``Layout`` (``layouts.py``) and the asset tree. Out: ``Episode``: a ``SceneSpec`` that equal episodes share, a
``Start``, the ``Roles`` that judging needs, and a note for every file that is replaced by a plain shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vecenv.assets import AssetsMissing
from vecenv.simpler.assets import files as assets
from vecenv.simpler.control.robots import GOOGLE_ROBOT, LinkMaterial, Robot
from vecenv.simpler.judge import Roles
from vecenv.simpler.layouts import Layout, Placed
from vecenv.simpler.models import ModelInfo, read_models
from vecenv.simpler.physics.spec import (
    GOOGLE_FINGER_ARMATURE,
    GOOGLE_FINGER_STOP,
    Box,
    CabinetBody,
    FingerLink,
    LinkSurface,
    ObjectBody,
    RobotBody,
    SceneSpec,
    StageBody,
    Start,
)
from vecenv.simpler.task_spec import BRIDGE, DRAWERS, SimplerTask
from vecenv.simpler.variants import station_meshes

# The cabinet's place in the world.
CABINET_POSE = (-0.295, 0.0, 0.017, 1.0, 0.0, 0.0, 0.0)
_DEFAULT_DENSITY = 1000.0
# Stand-ins for missing tables: lower and upper xy of the top, and how thick it is, metres. They end before the robot.
_TABLETOPS = {BRIDGE: ((-0.7, -0.6), (0.3, 0.6))}
_COKE_TABLETOP = ((-0.7, -0.5), (0.05, 0.9))
_THICKNESS = 0.1
_LEFT_FINGER, _RIGHT_FINGER = (
    tuple(f"link_finger{part}_{side}" for part in ("", "_tip", "_nail")) for side in ("left", "right")
)


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode, ready for physics.

    Attributes:
        task: its task. layout: where everything is.
        spec: the scene. start: where it begins. roles: of the objects.
        notes: missing files and their stand-ins.
        undrawn: missing files that only rendering needs: path in the asset tree, and what it is.
    """

    task: SimplerTask
    layout: Layout
    spec: SceneSpec
    start: Start
    roles: Roles
    notes: tuple[str, ...]
    undrawn: tuple[str, ...] = ()


def prepare(task: SimplerTask, layout: Layout, root: Path) -> Episode:
    """Everything physics needs for an episode.

    Args:
        task: the task.
        layout: one of its layouts.
        root: of the asset tree.

    Raises:
        AssetsMissing, ModelDataError: a missing file without a stand-in.
    """
    models = read_models(root / task.models_path) if task.models_path else {}
    notes: list[str] = []
    spec = SceneSpec(
        # The robot's versions differ in colour only, so physics scenes share the plain one.
        robot=robot_body(task.robot, root / task.robot.urdf_path(), layout.qpos),
        sim_hz=task.sim_hz,
        contact_offset=task.contact_offset,
        objects=tuple(_body(placed, models, root, notes) for placed in layout.objects),
        stage=_stage(task, root, notes),
        cabinet=CabinetBody(urdf=root / task.station, drawers=DRAWERS, pose=CABINET_POSE) if task.station else None,
    )
    roles = _roles(layout, models)
    return Episode(
        task=task,
        layout=layout,
        spec=spec,
        start=_start(layout, roles),
        roles=roles,
        notes=tuple(dict.fromkeys(notes)),
        undrawn=_undrawn(task, root),
    )


def robot_body(robot: Robot, urdf: Path, qpos: Sequence[float] | None = None) -> RobotBody:
    """A robot as physics sees it, with the remedies for PhysX 5 (``physics/spec.py``).

    Joints that nothing moves stay frozen where ``qpos`` [N] has them; without it they are left free.
    """
    drives, google, pairs = robot.drives, robot.name == GOOGLE_ROBOT.name, list(robot.never_touch)
    armature = [GOOGLE_FINGER_ARMATURE if i in robot.gripper else 0.0 for i in range(robot.dof)]
    if google:
        pairs += [(left, right) for left in _LEFT_FINGER for right in _RIGHT_FINGER]
    touching = dict.fromkeys(link for pair in pairs for link in pair)
    return RobotBody(
        urdf=urdf,
        joints=robot.joints,
        stiffness=tuple(drive.stiffness for drive in drives),
        damping=tuple(drive.damping for drive in drives),
        force_limit=tuple(drive.force_limit for drive in drives),
        surfaces=tuple((link, _surface(material)) for link, material in sorted(robot.materials.items())),
        ignored=tuple((link, _shared_bits(link, pairs)) for link in touching),
        tcp=robot.tool,
        fingers=tuple(
            FingerLink(link=link, side=side, opening=finger.opening)
            for side, finger in enumerate(robot.fingers)
            for link in finger.links
        ),
        armature=tuple(armature) if google else (),
        stop=(*robot.gripper, GOOGLE_FINGER_STOP) if google else None,
        frozen=() if qpos is None else tuple((robot.joints[i], float(qpos[i])) for i in robot.still),
    )


def _surface(material: LinkMaterial) -> LinkSurface:
    friction = (material.static_friction, material.dynamic_friction)
    return LinkSurface(friction=friction, patch_radius=material.patch_radius)


def _shared_bits(link: str, pairs: Sequence[tuple[str, str]]) -> int:
    return sum(1 << number for number, pair in enumerate(pairs) if link in pair)


def _body(placed: Placed, models: dict[str, ModelInfo], root: Path, notes: list[str]) -> ObjectBody:
    visual = assets.visual_mesh(placed.model, root)
    if visual.note:
        notes.append(visual.note)
    known = models.get(placed.model)
    return ObjectBody(
        name=placed.model,
        collision=assets.collision_mesh(placed.model, root),
        visual=visual.path or (visual.stand_in.mesh if visual.stand_in else None),
        density=placed.density or (known.density if known else _DEFAULT_DENSITY),
        anchored=placed.role == "fixture",
    )


def _stage(task: SimplerTask, root: Path, notes: list[str]) -> StageBody | None:
    """The surroundings that things can touch."""
    if task.stage.mesh is None or not task.stage.solid:
        return None
    found = assets.resolve(task.stage.mesh, root)
    if found.path is not None:
        return StageBody(mesh=found.path, mesh_pose=task.stage.turn, offset=task.stage.offset)
    assert found.stand_in is not None  # ``resolve`` gives one or the other
    notes.append(found.note)
    low, high = _TABLETOPS.get(task.suite, _COKE_TABLETOP)
    centre = (*((a + b) / 2 for a, b in zip(low, high, strict=True)), found.stand_in.top - _THICKNESS / 2)
    half = (*((b - a) / 2 for a, b in zip(low, high, strict=True)), _THICKNESS / 2)
    return StageBody(boxes=(Box(centre=_three(centre), half_size=_three(half)),))


def drawn_stage(episode: Episode, root: Path) -> StageBody | None:
    """The surroundings as they are drawn: rooms around cabinets are rendered but have no collision shapes."""
    stage = episode.task.stage
    if stage.solid or stage.mesh is None:
        return episode.spec.stage
    return StageBody(mesh=root / stage.mesh, mesh_pose=stage.turn, offset=stage.offset, solid=False)


def _undrawn(task: SimplerTask, root: Path) -> tuple[str, ...]:
    """A room's mesh and those of a cabinet's links that are missing from the tree."""
    wanted = {}
    if task.station is not None:
        wanted = dict.fromkeys(station_meshes(task.station, root), f"a part of {task.station.name}")
    if task.stage.mesh is not None and not task.stage.solid:
        wanted[task.stage.mesh] = "the room around the cabinet"
    return tuple(f"{path}, {what}" for path, what in wanted.items() if not (root / path).is_file())


def require_drawable(episode: Episode, root: Path) -> None:
    """Check that every file is there that rendering an episode needs.

    Raises:
        AssetsMissing: a file is missing; the message names it.
    """
    if episode.undrawn:
        raise AssetsMissing(assets.NAME, f"{root} has no {episode.undrawn[0]}", assets.HOW_TO_GET_VARIANTS)


def _three(values: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = values
    return float(x), float(y), float(z)


def _roles(layout: Layout, models: dict[str, ModelInfo]) -> Roles:
    roles = [placed.role for placed in layout.objects]
    sizes = [models[placed.model].size if placed.model in models else np.zeros(3) for placed in layout.objects]
    return Roles(
        source=roles.index("source") if "source" in roles else -1,
        target=roles.index("target") if "target" in roles else -1,
        drawer=DRAWERS.index(layout.drawer) if layout.drawer else -1,
        loose=tuple(i for i, role in enumerate(roles) if role != "fixture"),
        sizes=np.array(sizes).reshape(-1, 3),
    )


def _start(layout: Layout, roles: Roles) -> Start:
    poses = [(*placed.position, *placed.quat) for placed in layout.objects]
    return Start(
        base_pose=np.array([*layout.base_position, *layout.base_quat]),
        qpos=np.array(layout.qpos),
        objects=np.array(poses, float).reshape(-1, 7),
        source=roles.source,
        target=roles.target,
        late=tuple(i for i, placed in enumerate(layout.objects) if placed.role == "distractor"),
        drawer=roles.drawer,
        opened=layout.drawer_qpos,
    )
