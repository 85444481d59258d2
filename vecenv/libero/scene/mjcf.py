"""MJCF files as element trees: load one, resolve what it refers to, rename it, join it to another.

LIBERO's assets are small MJCF files meant to be merged by robosuite 1.4.0. The functions here reproduce the *effect* of
that merge (which element ends up where, under which name), so that a compiled model has upstream's bodies, joints and
geoms in upstream's order. Nothing here depends on tasks.
"""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path

from vecenv.errors import InvalidInput

# Attributes that name an element or refer to one by name, in the elements that occur in these assets.
_NAME_ATTRIBUTES = ("name", "material", "texture", "mesh", "joint", "site", "body1", "body2")
# Containers that are concatenated when two files are joined.
_SECTIONS = ("actuator", "sensor", "tendon", "equality", "contact")


class MjcfError(InvalidInput):
    """An asset file does not follow robosuite's conventions for MJCF; the message names the file."""


def load(path: Path) -> ET.Element:
    """Parse an MJCF file, write its default classes into the elements that use them and make file paths absolute.

    robosuite keeps only named default classes and drops the unnamed one, so the same is done here.

    Raises:
        MjcfError: the file is missing, is not XML, or uses a default class it does not define.
    """
    try:
        root = ET.parse(path).getroot()  # nosec B314 # a file of LIBERO or robosuite
    except FileNotFoundError as error:
        raise MjcfError(f"{path}: no such asset file") from error
    except ET.ParseError as error:
        raise MjcfError(f"{path}: not well-formed XML: {error}") from error
    _inline_classes(root, path)
    for element in root.iterfind("asset/*[@file]"):
        element.set("file", str((path.parent / element.attrib["file"]).resolve()))
    return root


def _inline_classes(root: ET.Element, path: Path) -> None:
    default = root.find("default")
    classes: dict[str, dict[str, dict[str, str]]] = {}
    if default is not None:
        for cls in default.iterfind("default"):
            classes[cls.get("class", "")] = {child.tag: dict(child.attrib) for child in cls}
        root.remove(default)
    for element in root.iter():
        name = element.attrib.pop("class", None)
        if name is None:
            continue
        if name not in classes:
            raise MjcfError(f"{path}: <{element.tag}> uses default class {name!r}, which the file does not define")
        for key, value in classes[name].get(element.tag, {}).items():
            element.attrib.setdefault(key, value)


def add_prefix(root: ET.Element, prefix: str) -> None:
    """Prefix every name and every reference below ``root``, in place; names that already have it are left alone."""
    for element in root.iter():
        for attribute in _NAME_ATTRIBUTES:
            value = element.get(attribute)
            if value is not None and not value.startswith(prefix):
                element.set(attribute, prefix + value)


def body(root: ET.Element, name: str) -> ET.Element:
    """The body called ``name``.

    Raises:
        MjcfError: there is none.
    """
    for element in root.iter("body"):
        if element.get("name") == name:
            return element
    raise MjcfError(f"no body named {name!r} in <{root.tag}>")


def section(root: ET.Element, tag: str) -> ET.Element:
    """The child called ``tag``, created at the end when it is missing."""
    found = root.find(tag)
    return ET.SubElement(root, tag) if found is None else found


def merge(target: ET.Element, source: ET.Element, *, into: ET.Element | None = None) -> None:
    """Join ``source``'s world children to ``into`` (default: ``target``'s worldbody), its sections to ``target``'s."""
    destination = section(target, "worldbody") if into is None else into
    destination.extend(list(section(source, "worldbody")))
    merge_assets(target, source)
    for tag in _SECTIONS:
        found = source.find(tag)
        if found is not None:
            section(target, tag).extend(list(found))


def merge_assets(target: ET.Element, source: ET.Element) -> None:
    """Append ``source``'s assets to ``target``'s; of those of one kind and name only the first stays."""
    assets = section(target, "asset")
    known = {(asset.tag, asset.get("name")) for asset in assets}
    for asset in section(source, "asset"):
        key = (asset.tag, asset.get("name"))
        if key[1] is None or key not in known:
            assets.append(asset)
            known.add(key)


def object_subtree(root: ET.Element, name: str, *, free: bool, path: Path) -> ET.Element:
    """The body of a LIBERO object file, named and completed as robosuite's ``MujocoXMLObject`` does it.

    Args:
        root: the loaded file; its first world body holds the body called ``object``.
        name: instance name; every element gets the prefix ``{name}_``.
        free: give it a free joint (movable object) or none (fixture).
        path: the file, for messages.

    Returns:
        The body ``{name}_main``; unnamed geoms are called ``g{i}`` by their position among all geoms.

    Raises:
        MjcfError: the file has no body called ``object``.
    """
    found = root.find("worldbody/body/body[@name='object']")
    if found is None:
        raise MjcfError(f"{path}: no <body name='object'> inside the first world body")
    tree = copy.deepcopy(found)
    tree.set("name", "main")
    for index, geom in enumerate(tree.iter("geom")):
        if geom.get("name") is None:
            geom.set("name", f"g{index}")
    if free:
        ET.SubElement(tree, "joint", {"type": "free", "damping": "0.0005", "name": "joint0"})
    site = {"pos": "0 0 0", "size": "0.002 0.002 0.002", "rgba": "1 0 0 0", "type": "sphere", "group": "0"}
    ET.SubElement(tree, "site", {**site, "name": "default_site"})
    add_prefix(tree, f"{name}_")
    return tree


def remove_visuals(root: ET.Element) -> None:
    """Drop everything that neither collides nor weighs: visual geoms, materials, textures, and meshes left unused.

    Only group 0 geoms enter the inertia of these models (``inertiagrouprange="0 0"``), so masses do not change.
    """
    for parent in root.iter():
        for geom in [child for child in parent if child.tag == "geom" and _is_visual(child)]:
            parent.remove(geom)
    used = {geom.get("mesh") for geom in root.iter("geom")}
    assets = section(root, "asset")
    for asset in list(assets):
        if asset.tag != "mesh" or asset.get("name") not in used:
            assets.remove(asset)
    for geom in root.iter("geom"):
        geom.attrib.pop("material", None)


def _is_visual(geom: ET.Element) -> bool:
    collides = geom.get("contype", "1") != "0" or geom.get("conaffinity", "1") != "0"
    return not collides and geom.get("group", "0") != "0"


def numbers(text: str) -> tuple[float, ...]:
    """The floats in a space-separated attribute."""
    return tuple(float(word) for word in text.split())


def text(values: Iterable[float]) -> str:
    """An attribute value that parses back to exactly these floats."""
    return " ".join(repr(float(value)) for value in values)
