"""A small asset tree for SIMPLER, generated: robots of boxes with the real joints, boxes for objects, flat pictures.

In: an empty folder. Out: the same folder in upstream's layout, with every file that the 25 tasks and their variants ask
for except stages; for visual matching's the library has stand-ins. Lengths between joints are those of the real robots,
so the same poses are within reach; everything else is as plain as it can be.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image

from vecenv.simpler.control.robots import GOOGLE_ROBOT, WIDOWX
from vecenv.simpler.task_spec import DATA
from vecenv.simpler.task_table import PLAIN_MODELS_FILE, PLAIN_TRIPLETS
from vecenv.simpler.tasks import TASKS

_Vector = tuple[float, float, float]
# Half sizes of objects that must not be cubes, metres.
_FLAT = {
    "bridge_plate_objaverse_larger": (0.055, 0.055, 0.003),
    "table_cloth_generated_shorter": (0.06, 0.04, 0.002),
    "dummy_sink_target_plane": (0.06, 0.08, 0.002),
    "sink": (0.15, 0.15, 0.01),
}
_CUBE = (0.014, 0.014, 0.014)
_TURN = (-1.1506, 0.0, 0.0)
_DRAWERS = {"top": 0.668, "middle": 0.423, "bottom": 0.178}


def build(root: Path) -> Path:
    """Write the tree and return its root."""
    descriptions = root / "mani_skill2_real2sim/assets/descriptions"
    for robot, text in ((WIDOWX, _widowx()), (GOOGLE_ROBOT, _google())):
        for version in robot.versions:
            _write(root / robot.urdf_path(version), text)
    assert descriptions.is_dir()
    for task in TASKS.values():
        for picture in task.overlays:
            _picture(root / picture, (task.camera.width, task.camera.height))
    for name in ("mk_station_recolor", "mk_station", "mk_station2", "mk_station3"):
        _write(root / DATA / f"custom/{name}.urdf", _station())
    _objects(root)
    return root


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def _picture(path: Path, size: tuple[int, int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        Image.new("RGB", size, (90, 120, 150)).save(path)


# ---------------------------------------------------------------------------------------------------------------------
# Objects.


def _objects(root: Path) -> None:
    models: dict[str, set[str]] = {}
    for task in TASKS.values():
        if task.models_file:
            names = {*task.models, *itertools.chain.from_iterable(task.triplets)}
            models.setdefault(task.models_file, set()).update(names)
    models[PLAIN_MODELS_FILE].update(itertools.chain.from_iterable(PLAIN_TRIPLETS))
    for file, names in models.items():
        _write(root / "data/custom" / file, json.dumps({name: _info(name) for name in sorted(names)}))
    for name in {*itertools.chain.from_iterable(models.values()), "sink"}:
        text = _box_mesh(_FLAT.get(name, _CUBE))
        for mesh in ("collision.obj", "textured.obj"):
            _write(root / "data/custom/models" / name / mesh, text)


def _info(name: str) -> dict[str, object]:
    half = _FLAT.get(name, _CUBE)
    return {"bbox": {"min": [-x for x in half], "max": list(half)}, "scales": [1.0], "density": 700}


def _box_mesh(half: _Vector) -> str:
    corners = [np.array(signs) * half for signs in itertools.product((-1, 1), repeat=3)]
    faces = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in corners]
    for a, b, c, d in faces:
        lines += [f"f {a + 1} {b + 1} {c + 1}", f"f {a + 1} {c + 1} {d + 1}"]
    return "\n".join(["o box", *lines, ""])


# ---------------------------------------------------------------------------------------------------------------------
# Robots and the cabinet.


def _link(name: str, boxes: Iterable[tuple[_Vector, _Vector]] = (), mass: float = 0.3) -> str:
    shapes = "".join(
        f'<{tag}><origin xyz="{_text(centre)}"/><geometry><box size="{_text(size)}"/></geometry></{tag}>'
        for centre, size in boxes
        for tag in ("collision", "visual")
    )
    inertia = mass * 3e-3
    body = f'<mass value="{mass}"/><inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial><origin xyz="0 0 0"/>{body}</inertial>{shapes}</link>'


def _joint(
    name: str,
    parent: str,
    child: str,
    xyz: _Vector,
    axis: _Vector | None = None,
    limits: tuple[float, float] = (-3.0, 3.0),
    kind: str = "revolute",
    rpy: _Vector = (0.0, 0.0, 0.0),
) -> str:
    kind = kind if axis else "fixed"
    moves = f'<axis xyz="{_text(axis or ())}"/><limit lower="{limits[0]}" upper="{limits[1]}" effort="1" velocity="1"/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_text(xyz)}" rpy="{_text(rpy)}"/>{moves if axis else ""}</joint>'
    )


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def _robot(name: str, parts: Iterable[str]) -> str:
    return f'<robot name="{name}">{"".join(parts)}</robot>'


_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_KNUCKLE = [((0.0, 0.0, 0.0), (0.03, 0.03, 0.03))]


def _widowx() -> str:
    chain = [
        ("waist", "base_link", "shoulder_link", (0, 0, 0.072), _Z),
        ("shoulder", "shoulder_link", "upper_arm_link", (0, 0, 0.0386), _Y),
        ("elbow", "upper_arm_link", "upper_forearm_link", (0.0498, 0, 0.25), _Y),
        ("forearm_roll", "upper_forearm_link", "lower_forearm_link", (0.175, 0, 0), _X),
        ("wrist_angle", "lower_forearm_link", "wrist_link", (0.075, 0, 0), _Y),
        ("wrist_rotate", "wrist_link", "gripper_link", (0.065, 0, 0), _X),
        ("ee_arm", "gripper_link", "ee_arm_link", (0.043, 0, 0), None),
        ("gripper_bar", "ee_arm_link", "gripper_bar_link", (0, 0, 0), None),
        ("ee_bar", "gripper_bar_link", "fingers_link", (0.023, 0, 0), None),
        ("ee_gripper", "fingers_link", "ee_gripper_link", (0.0276, 0, 0), None),
    ]
    bare = {"ee_arm_link", "fingers_link", "ee_gripper_link"}
    links = [_link("base_link", _KNUCKLE)] + [_link(row[2], () if row[2] in bare else _KNUCKLE) for row in chain]
    joints = [_joint(name, parent, child, xyz, axis) for name, parent, child, xyz, axis in chain]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        links.append(_link(f"{side}_finger_link", [((0.025, 0.0, 0.0), (0.05, 0.01, 0.02))], 0.02))
        axis = (0.0, sign, 0.0)
        finger = (f"{side}_finger", "fingers_link", f"{side}_finger_link", (0, 0, 0), axis, (0.015, 0.037), "prismatic")
        joints.append(_joint(*finger))
    return _robot("widowx", links + joints)


def _google() -> str:
    chain = [
        ("joint_torso", "link_base", "link_torso", (0, 0, 0.5945), _Z),
        ("joint_shoulder", "link_torso", "link_shoulder", (0, -0.1673, 0.113), _Y),
        ("joint_bicep", "link_shoulder", "link_bicep", (0, 0.0023, 0.215), _Z),
        ("joint_elbow", "link_bicep", "link_elbow", (0, -0.064, 0.185), _Y),
        ("joint_forearm", "link_elbow", "link_forearm", (0, -0.101, 0.0915), _Z),
        ("joint_wrist", "link_forearm", "link_wrist", (0, -0.006, 0.2735), _Y),
        ("joint_gripper", "link_wrist", "link_gripper", (0, 0.006, 0.1091), _Z),
        ("gripper_tcp_joint", "link_gripper", "link_gripper_tcp", (0.0043, 0.0019, 0.1635), None),
        ("joint_head_pan", "link_base", "link_head_pan", (0, 0, 1.169), _Z),
        ("joint_head_tilt", "link_head_pan", "link_head_tilt", (0.0718, 0, 0.1185), _Y),
        ("joint_wheel_left", "link_base", "link_wheel_left", (0, 0.1833, 0), None),
        ("joint_wheel_right", "link_base", "link_wheel_right", (0, -0.1833, 0), None),
    ]
    links = [_link("link_base", _KNUCKLE)]
    links += [_link(row[2], () if row[2] == "link_gripper_tcp" else _KNUCKLE) for row in chain]
    joints = [_joint(name, parent, child, xyz, axis, (-4.5, 4.5)) for name, parent, child, xyz, axis in chain]
    camera = ("joint_camera_mount", "link_head_tilt", "link_camera", (0.1049, 0, 0))
    joints.append(_joint(*camera, rpy=(-np.pi / 2, 0.0, -np.pi / 2)))
    links.append(_link("link_camera"))
    for side, y, yaw in (("right", -0.025, np.pi), ("left", 0.025, 0.0)):
        finger, tip, nail = (f"link_finger{part}_{side}" for part in ("", "_tip", "_nail"))
        rpy = (_TURN[0], 0.0, yaw)
        joint = (f"joint_finger_{side}", "link_gripper", finger, (0, y, 0.0586), _X, (-0.0001, 1.3))
        joints.append(_joint(*joint, rpy=rpy))
        joints.append(_joint(f"joint_finger_tip_{side}", finger, tip, (0, -0.0104, 0.0642), rpy=(0.45, 0, 0)))
        joints.append(_joint(f"joint_finger_nail_{side}", tip, nail, (0, 0, 0.0463)))
        links.append(_link(finger, [((0, 0, 0.03), (0.02, 0.01, 0.06))], 0.03))
        links.append(_link(tip, [((0, 0, 0.02), (0.02, 0.008, 0.05))], 0.015))
        links.append(_link(nail, [((0, 0, 0.0), (0.014, 0.002, 0.004))], 0.001))
    return _robot("google_robot", links + joints)


def _station() -> str:
    """A table on a frame with three drawers; a drawer's third collision shape is its floor."""
    sides = [((0, y, 0.4225), (0.59, 0.02, 0.845)) for y in (-0.2975, 0.2975)]
    links = [_link("body", [*sides, ((0, 0, 0.855), (0.63, 0.615, 0.02))])]
    joints = []
    for name, height in _DRAWERS.items():
        boxes = [
            ((0.305, 0, 0), (0.015, 0.59, 0.14)),
            ((-0.285, 0, -0.02), (0.02, 0.515, 0.1)),
            ((0, 0, -0.06), (0.55, 0.515, 0.02)),
            ((0.3425, 0, 0.02), (0.005, 0.1, 0.005)),
        ]
        links.append(_link(f"{name}_drawer", boxes, 1.0))
        joint = (f"{name}_drawer_joint", "body", f"{name}_drawer", (0, 0, height), _X, (0.0, 0.5), "prismatic")
        joints.append(_joint(*joint))
    return _robot("station", links + joints)
