"""The MJCF that every scene has: simulation options, table, textures and robot, as robosuite 1.4.0 writes them.

In: element trees of asset files and the facts of an arena. Out: the same trees changed, or new ones. Objects, fixtures
and regions are ``vecenv.libero.scene.scene``'s.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from vecenv.libero.robot import ARM_DAMPING, ARM_FRICTIONLOSS, BASE_BODY, HAND_BODY
from vecenv.libero.scene import contacts, mjcf
from vecenv.libero.scene.arenas import Arena
from vecenv.libero.scene.contacts import Contacts

# Memory of one simulation's contacts and constraints, allocated as it is used. The 32 scenes use 1.3 MB at most in the
# first 60 substeps of their starts with all fixtures in one place. A full arena is reported as a fault, never ignored.
ARENA_MEMORY = "16M"

# Custom numerics that MJX's pure-JAX implementation reads its limits from; -1 is none
# (``vecenv.libero.physics.budgets``).
CONTACT_LIMIT, PAIR_LIMIT = "max_contact_points", "max_geom_pairs"


def choose_contacts(root: ET.Element, chosen: Contacts) -> None:
    """Write the mark of chosen contacts into an MJCF tree; errors of ``contacts.checked``."""
    if contacts.checked(chosen) == "current":
        return
    numeric = root.find(f"custom/numeric[@name='{contacts.NUMERIC}']")
    assert numeric is not None
    numeric.set("data", repr(contacts.MARK))


def base() -> ET.Element:
    """The options every robosuite 1.4.0 scene is compiled with."""
    root = ET.Element("mujoco", {"model": "libero"})
    ET.SubElement(root, "compiler", {"angle": "radian", "inertiagrouprange": "0 0"})
    ET.SubElement(
        root,
        "option",
        {"timestep": "0.002", "impratio": "20", "cone": "elliptic", "density": "1.2", "viscosity": "0.00002"},
    )
    ET.SubElement(root, "size", {"memory": ARENA_MEMORY})
    visual = ET.SubElement(root, "visual")
    ET.SubElement(visual, "map", {"znear": "0.001"})
    custom = ET.SubElement(root, "custom")
    ET.SubElement(custom, "numeric", {"name": contacts.NUMERIC, "data": "0"})
    for name in (CONTACT_LIMIT, PAIR_LIMIT):
        ET.SubElement(custom, "numeric", {"name": name, "data": "-1"})
    for tag in ("asset", "worldbody", "actuator", "sensor"):
        ET.SubElement(root, tag)
    return root


def resize_table(root: ET.Element, arena: Arena) -> None:
    """Give the table of an arena file the size, friction and height of the workspace."""
    assert arena.table is not None
    half = np.array(arena.table.full_size) / 2
    table = mjcf.body(root, arena.table_body)
    table.set("pos", mjcf.text(np.array([0, 0, -half[2]]) + arena.workspace_offset))
    for geom in table.findall("geom"):
        name = geom.get("name", "")
        if name in ("table_collision", "table_visual"):
            geom.set("size", mjcf.text(half))
        if name == "table_collision":
            geom.set("friction", mjcf.text(arena.table.friction))
    for site in table.findall("site[@name='table_top']"):
        site.set("pos", mjcf.text((0, 0, half[2])))
    _place_legs(table, arena, half)


def _place_legs(table: ET.Element, arena: Arena, half: np.ndarray) -> None:
    """Visual legs, inset by 0.1 m from the table's corners."""
    leg = (arena.workspace_offset[2] - half[2]) / 2
    for index, (dx, dy) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1)), start=1):
        geom = table.find(f"geom[@name='table_leg{index}_visual']")
        if geom is not None:
            geom.set("pos", mjcf.text((dx * (half[0] - 0.1), dy * (half[1] - 0.1), -leg)))
            geom.set("size", mjcf.text((0.025, leg)))


def set_textures(root: ET.Element, arena: Arena) -> None:
    """Point the floor's and the wall's texture to the arena's files."""
    for name, file in (("texplane", arena.floor_texture), ("tex-wall", arena.wall_texture)):
        texture = root.find(f"asset/texture[@name='{name}']")
        if texture is not None:
            texture.set("file", str(Path(texture.attrib["file"]).with_name(file)))


def robot(robosuite_root: Path, arena: Arena) -> ET.Element:
    """The Panda with its gripper and mount, named and tuned as robosuite does it."""
    arm = mjcf.load(robosuite_root / "robots" / "panda" / "robot.xml")
    for index, joint in enumerate(arm.iter("joint")):
        joint.set("damping", mjcf.text((ARM_DAMPING[index],)))
        joint.attrib.setdefault("frictionloss", mjcf.text((ARM_FRICTIONLOSS,)))
        joint.attrib.setdefault("armature", mjcf.text((5.0 / (index + 1),)))
    _name_geoms(arm)
    mjcf.add_prefix(arm, "robot0_")
    mjcf.body(arm, BASE_BODY).set("pos", mjcf.text(arena.robot_base))

    gripper = mjcf.load(robosuite_root / "grippers" / "panda_gripper.xml")
    mjcf.add_prefix(gripper, "gripper0_")
    mjcf.merge(arm, gripper, into=mjcf.body(arm, HAND_BODY))

    mount = mjcf.load(robosuite_root / "mounts" / ("rethink_mount.xml" if arena.mounted else "null_mount.xml"))
    mjcf.add_prefix(mount, "mount0_")
    mjcf.body(mount, "mount0_base").set("pos", "0 0 0.01" if arena.mounted else "0 0 0")
    mjcf.merge(arm, mount, into=mjcf.body(arm, BASE_BODY))
    # The wrist force and torque sensors cost a full inverse-dynamics pass a step and nothing here reads them.
    arm.remove(mjcf.section(arm, "sensor"))
    return arm


def _name_geoms(root: ET.Element) -> None:
    counts = {"col": 0, "vis": 0}
    for geom in root.iter("geom"):
        if geom.get("name") is None:
            kind = "vis" if geom.get("group") == "1" else "col"
            geom.set("name", f"g{counts[kind]}_{kind}")
            counts[kind] += 1
