"""MJCF trees are loaded, renamed and joined as robosuite does it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vecenv.libero.scene import mjcf
from vecenv.libero.scene.mjcf import MjcfError

OBJECT = """
<mujoco model="cup">
  <default>
    <geom friction="9 9 9"/>
    <default class="visual"><geom group="1" contype="0" conaffinity="0"/><site rgba="1 1 1 1"/></default>
  </default>
  <asset>
    <mesh name="cup_mesh" file="meshes/cup.obj"/>
    <mesh name="hull" file="meshes/hull.obj"/>
    <texture name="paint" file="../paint.png"/>
    <material name="cup_mat" texture="paint"/>
  </asset>
  <worldbody>
    <body>
      <body name="object">
        <geom class="visual" type="mesh" mesh="cup_mesh" material="cup_mat"/>
        <geom group="0" type="mesh" mesh="hull" material="cup_mat"/>
        <body name="lid">
          <joint name="hinge" type="hinge"/>
          <geom name="knob" class="visual" group="2" size="0.01"/>
          <geom group="0" type="box" size="1 1 1"/>
          <site class="visual" name="rim"/>
        </body>
      </body>
      <site name="bottom_site" pos="0 0 -0.1"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def cup(tmp_path: Path) -> Path:
    path = tmp_path / "cups" / "cup.xml"
    path.parent.mkdir()
    path.write_text(OBJECT)
    return path


def named(root: ET.Element, tag: str) -> list[str | None]:
    return [element.get("name") for element in root.iter(tag)]


# -- loading -----------------------------------------------------------------------------------------------------------


def test_default_classes_are_written_into_their_elements(cup: Path) -> None:
    root = mjcf.load(cup)
    mesh, hull, knob, _ = root.iter("geom")
    assert (mesh.get("group"), mesh.get("contype"), mesh.get("conaffinity")) == ("1", "0", "0")
    assert knob.get("group") == "2", "an element's own attribute wins"
    assert hull.get("contype") is None
    assert next(root.iter("site")).get("rgba") == "1 1 1 1"
    assert all("class" not in element.attrib for element in root.iter())
    assert root.find("default") is None


def test_the_unnamed_default_class_is_dropped(cup: Path) -> None:
    assert all(geom.get("friction") is None for geom in mjcf.load(cup).iter("geom"))


def test_files_become_absolute(cup: Path) -> None:
    files = [Path(e.attrib["file"]) for e in mjcf.load(cup).iterfind("asset/*[@file]")]
    assert files == [cup.parent / "meshes/cup.obj", cup.parent / "meshes/hull.obj", cup.parent.parent / "paint.png"]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(MjcfError, match=r"teapot\.xml: no such asset file"):
        mjcf.load(tmp_path / "teapot.xml")


def test_a_broken_file_is_named(cup: Path) -> None:
    cup.write_text("<mujoco><asset></mujoco>")
    with pytest.raises(MjcfError, match=r"cup\.xml: not well-formed XML"):
        mjcf.load(cup)


def test_a_class_that_is_not_defined_is_named(cup: Path) -> None:
    cup.write_text(OBJECT.replace('class="visual" type', 'class="shiny" type'))
    with pytest.raises(MjcfError, match=r"cup\.xml: <geom> uses default class 'shiny'"):
        mjcf.load(cup)


# -- renaming ----------------------------------------------------------------------------------------------------------


def test_a_prefix_goes_to_names_and_references_once(cup: Path) -> None:
    root = mjcf.load(cup)
    for _ in range(2):
        mjcf.add_prefix(root, "cup_1_")
    assert named(root, "mesh") == ["cup_1_cup_mesh", "cup_1_hull"]
    assert [geom.get("mesh") for geom in root.iter("geom")] == ["cup_1_cup_mesh", "cup_1_hull", None, None]
    assert root.find("asset/material").attrib == {"name": "cup_1_cup_mat", "texture": "cup_1_paint"}  # pyright: ignore
    assert named(root, "joint") == ["cup_1_hinge"]


def test_an_object_becomes_a_body_with_robosuites_names(cup: Path) -> None:
    tree = mjcf.object_subtree(mjcf.load(cup), "cup_1", free=True, path=cup)
    assert named(tree, "body") == ["cup_1_main", "cup_1_lid"]
    assert named(tree, "geom") == ["cup_1_g0", "cup_1_g1", "cup_1_knob", "cup_1_g3"]
    assert named(tree, "joint") == ["cup_1_hinge", "cup_1_joint0"]
    assert named(tree, "site") == ["cup_1_rim", "cup_1_default_site"]
    free = tree.find("joint")
    assert free is not None
    assert (free.get("type"), free.get("damping")) == ("free", "0.0005")


def test_a_fixture_gets_no_free_joint(cup: Path) -> None:
    tree = mjcf.object_subtree(mjcf.load(cup), "cup_1", free=False, path=cup)
    assert named(tree, "joint") == ["cup_1_hinge"]


def test_the_loaded_file_stays_as_it_was(cup: Path) -> None:
    root = mjcf.load(cup)
    before = ET.tostring(root)
    mjcf.object_subtree(root, "cup_1", free=True, path=cup)
    assert ET.tostring(root) == before


def test_a_file_without_an_object_is_named(cup: Path) -> None:
    cup.write_text(OBJECT.replace('"object"', '"thing"'))
    with pytest.raises(MjcfError, match=r"cup\.xml: no <body name='object'>"):
        mjcf.object_subtree(mjcf.load(cup), "cup_1", free=True, path=cup)


# -- finding and joining -----------------------------------------------------------------------------------------------


def test_bodies_are_found_by_name_at_any_depth(cup: Path) -> None:
    root = mjcf.load(cup)
    assert mjcf.body(root, "lid").find("joint") is not None
    with pytest.raises(MjcfError, match="no body named 'handle' in <mujoco>"):
        mjcf.body(root, "handle")


def test_sections_are_made_when_missing() -> None:
    root = ET.fromstring("<mujoco><asset/></mujoco>")
    assert mjcf.section(root, "asset") is root[0]
    assert mjcf.section(root, "sensor") is root[1] is mjcf.section(root, "sensor")


def test_joining_appends_children_assets_and_sections_in_order() -> None:
    target = ET.fromstring(
        "<mujoco><worldbody><body name='a'/></worldbody><actuator><motor name='m'/></actuator></mujoco>"
    )
    source = ET.fromstring(
        "<mujoco><asset><mesh name='x'/></asset><worldbody><body name='b'/><site name='s'/></worldbody>"
        "<actuator><motor name='n'/></actuator><sensor><force name='f'/></sensor><option timestep='1'/></mujoco>"
    )
    mjcf.merge(target, source)
    assert [child.get("name") for child in mjcf.section(target, "worldbody")] == ["a", "b", "s"]
    assert named(target, "motor") == ["m", "n"]
    assert named(target, "force") == ["f"]
    assert named(target, "mesh") == ["x"]
    assert target.find("option") is None


def test_joining_into_a_body_puts_the_children_there() -> None:
    target = ET.fromstring("<mujoco><worldbody><body name='hand'/></worldbody></mujoco>")
    source = ET.fromstring("<mujoco><worldbody><body name='finger'/></worldbody></mujoco>")
    mjcf.merge(target, source, into=mjcf.body(target, "hand"))
    assert named(mjcf.body(target, "hand"), "body") == ["hand", "finger"]


def test_of_assets_of_one_kind_and_name_the_first_stays() -> None:
    """Also within one file: a stove's file names two textures alike. Unnamed ones are never the same."""
    target = ET.fromstring("<mujoco><asset><texture name='x' file='0'/></asset></mujoco>")
    source = ET.fromstring(
        "<mujoco><asset><texture name='x' file='1'/><material name='x'/><texture name='y' file='2'/>"
        "<texture name='y' file='3'/><texture file='4'/><texture file='5'/></asset></mujoco>"
    )
    mjcf.merge_assets(target, source)
    kept = [(asset.tag, asset.get("name"), asset.get("file")) for asset in target.iterfind("asset/*")]
    assert kept == [
        ("texture", "x", "0"),
        ("material", "x", None),
        ("texture", "y", "2"),
        ("texture", None, "4"),
        ("texture", None, "5"),
    ]


# -- leaving the visuals out -------------------------------------------------------------------------------------------


def test_only_what_collides_or_weighs_stays(cup: Path) -> None:
    root = mjcf.load(cup)
    weight = ET.SubElement(mjcf.body(root, "lid"), "geom", {"contype": "0", "conaffinity": "0", "name": "weight"})
    half = ET.SubElement(mjcf.body(root, "lid"), "geom", {"contype": "0", "group": "1", "name": "half"})
    mjcf.remove_visuals(root)
    geoms = list(root.iter("geom"))
    assert [geom.get("mesh") or geom.get("name") for geom in geoms] == ["hull", None, "weight", "half"]
    assert weight in geoms, "group 0 enters the inertia"
    assert half in geoms, "one of the two bits is enough to collide"
    assert [(asset.tag, asset.get("name")) for asset in root.iterfind("asset/*")] == [("mesh", "hull")]
    assert all(geom.get("material") is None for geom in geoms)


# -- numbers -----------------------------------------------------------------------------------------------------------


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=9))
def test_numbers_survive_being_written(values: list[float]) -> None:
    assert mjcf.numbers(mjcf.text(values)) == tuple(values)
