"""A parsed BDDL problem becomes a MuJoCo model with upstream's bodies, joints, geoms and sites in upstream's order.

In: a :class:`~vecenv.libero.scene.bddl.Problem`. Out: a :class:`Scene`, the compiled ``MjModel`` plus the names and ids
that the rest of the package needs (which body is which object, which geoms count as its contact geoms, where a region's
site hangs, where fixtures go). The physics model leaves everything out that neither collides nor weighs.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import mujoco
import numpy as np

from vecenv import assets
from vecenv.errors import InvalidInput
from vecenv.libero.robot import ARM_JOINTS, BASE_BODY, FINGER_JOINTS, GRIP_SITE, HAND_BODY
from vecenv.libero.scene import catalog, contacts, elements, mjcf
from vecenv.libero.scene.arenas import ARENAS, Arena
from vecenv.libero.scene.bddl import Problem, Region
from vecenv.libero.scene.contacts import Contacts

_ZONE_HALF_HEIGHT = 0.007


class SceneError(InvalidInput):
    """A problem cannot be turned into a model; the message names the problem file and the reason."""


@dataclass(frozen=True, kw_only=True)
class RegionSite:
    """A named region as goals see it.

    Attributes:
        name: the region's full BDDL name, which is also its site's name.
        parent: the object or fixture it belongs to; None for a zone on the table or floor.
        joints: joints of the body that carries the site (the drawer's slide, say), upstream's choice.
        size: half extents, metres, in the site's frame.
        pos: position in the carrying body's frame, metres.
        body: the carrying body.
    """

    name: str
    parent: str | None
    joints: tuple[str, ...]
    size: tuple[float, float, float]
    pos: tuple[float, float, float]
    body: str


@dataclass(frozen=True, kw_only=True)
class Entity:
    """An object or fixture of the scene.

    Attributes:
        name, category: as BDDL declares them.
        fixture: fixed to the world (its pose is an input) rather than free.
        root_body: name of its root body.
        joints: its joints in upstream's order, the free joint of a movable object included.
        contact_geoms: names of the geoms that upstream's contact tests look at.
        bottom_z, top_z: heights of the file's ``bottom_site`` and ``top_site`` relative to the root body, metres.
        radius: x of the file's ``horizontal_radius_site``, metres: how far apart upstream's samplers keep things.
    """

    name: str
    category: str
    fixture: bool
    root_body: str
    joints: tuple[str, ...]
    contact_geoms: tuple[str, ...]
    bottom_z: float
    top_z: float
    radius: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A compiled scene, equal only to itself.

    Attributes:
        problem_name: LIBERO's problem class, lower case.
        model: the compiled model; treat it as read-only.
        arena: the workspace's facts.
        entities: objects, then fixtures, in upstream's order, by name.
        regions: regions by name.
    """

    problem_name: str
    model: mujoco.MjModel
    arena: Arena
    entities: Mapping[str, Entity]
    regions: Mapping[str, RegionSite]

    @property
    def contacts(self) -> Contacts:
        """Which contacts its physics has; see ``vecenv.libero.scene.contacts``."""
        return contacts.of(self.model)

    @cached_property
    def arm_qpos(self) -> np.ndarray:
        """Addresses of the seven arm joints in qpos, int [7]."""
        return np.array([self.model.joint(name).qposadr[0] for name in ARM_JOINTS])

    @cached_property
    def finger_qpos(self) -> np.ndarray:
        """Addresses of the two finger joints in qpos, int [2]."""
        return np.array([self.model.joint(name).qposadr[0] for name in FINGER_JOINTS])

    @cached_property
    def grip_site(self) -> int:
        """Id of the site between the fingertips, the controlled frame."""
        return self.model.site(GRIP_SITE).id

    @cached_property
    def hand_body(self) -> int:
        """Id of the hand body, whose orientation upstream reports as ``robot0_eef_quat``."""
        return self.model.body(HAND_BODY).id

    @cached_property
    def base_z(self) -> float:
        """Height of the robot's base body, metres."""
        return float(self.model.body(BASE_BODY).pos[2])

    @cached_property
    def fixtures(self) -> tuple[Entity, ...]:
        """The fixtures, in upstream's order."""
        return tuple(entity for entity in self.entities.values() if entity.fixture)

    @cached_property
    def objects(self) -> tuple[Entity, ...]:
        """The movable objects, in upstream's order."""
        return tuple(entity for entity in self.entities.values() if not entity.fixture)

    @property
    def workspace_bounds(self) -> np.ndarray:
        """Lower and upper corner of the workspace, [2, 3], metres."""
        z = self.base_z
        return np.array([[-0.7, -0.4, z - 0.10], [0.3, 0.5, z + 0.35]])


@dataclass(frozen=True, kw_only=True)
class SceneSource:
    """A scene before MuJoCo compiles it: together with the files the MJCF refers to, all that the result depends on.

    Attributes:
        problem_name, arena, entities, regions: as in :class:`Scene`.
        xml: the MJCF, with absolute file paths.
        origin: the problem's file, for messages.
    """

    problem_name: str
    xml: str
    arena: Arena
    entities: Mapping[str, Entity]
    regions: Mapping[str, RegionSite]
    origin: str

    def compile(self, edit: Callable[[mujoco.MjSpec], None] | None = None) -> Scene:
        """Let MuJoCo compile it.

        Args:
            edit: changes the parsed MJCF before.

        Raises:
            SceneError: MuJoCo refuses the model.
        """
        try:
            spec = mujoco.MjSpec.from_string(self.xml)
            if edit is not None:
                edit(spec)
            model = spec.compile()
        except ValueError as error:
            raise SceneError(f"{self.origin}: MuJoCo rejects the scene: {error}") from error
        contacts.remark(model)
        return Scene(
            problem_name=self.problem_name, model=model, arena=self.arena, entities=self.entities, regions=self.regions
        )


def contact_sensor_name(first: str, second: str) -> str:
    """Name of the sensor that counts the contacts between two things, in either order."""
    return f"contact:{min(first, second)}|{max(first, second)}"


def scene_source(
    problem: Problem,
    *,
    contact_pairs: Iterable[tuple[str, str]] = (),
    visual: bool = False,
    contacts: Contacts = "published",
) -> SceneSource:
    """Put the MJCF of a problem together; arguments and errors as for ``compile_scene``."""
    builder = _Builder(problem)
    elements.choose_contacts(builder.root, contacts)
    builder.add_contact_sensors(contact_pairs)
    if not visual:
        mjcf.remove_visuals(builder.root)
    return SceneSource(
        problem_name=problem.name,
        xml=ET.tostring(builder.root, encoding="unicode"),
        arena=builder.arena,
        entities=MappingProxyType(builder.entities),
        regions=MappingProxyType(builder.regions),
        origin=problem.source,
    )


def compile_scene(
    problem: Problem,
    *,
    contact_pairs: Iterable[tuple[str, str]] = (),
    visual: bool = False,
    contacts: Contacts = "published",
) -> Scene:
    """Build the model of a problem.

    Args:
        problem: a parsed LIBERO problem.
        contact_pairs: pairs of objects and fixtures whose contacts goals test; each becomes a contact sensor.
        visual: keep visual geoms, materials and textures. The physics does not depend on it.
        contacts: ``"published"``, those of the MuJoCo that LIBERO was made with, or ``"current"``.

    Raises:
        SceneError: unknown problem class or object category, an asset that breaks the conventions, or a model that
            MuJoCo refuses.
        ContactsError: other contacts.
    """
    return scene_source(problem, contact_pairs=contact_pairs, visual=visual, contacts=contacts).compile()


class _Builder:
    """Assembles the element tree of one problem: arena, robot, objects, fixtures, region sites."""

    def __init__(self, problem: Problem) -> None:
        if problem.name not in ARENAS:
            raise SceneError(
                f"{problem.source}: problem class {problem.name!r} has no workspace here; known: {', '.join(ARENAS)}"
            )
        self.problem = problem
        self.arena = ARENAS[problem.name]
        self.libero = assets.libero_assets_root()
        self.robosuite = assets.robosuite_assets_root()
        self.entities: dict[str, Entity] = {}
        self.regions: dict[str, RegionSite] = {}
        self.root = elements.base()
        try:
            self._assemble()
        except (mjcf.MjcfError, catalog.UnknownCategory, SceneError) as error:
            raise SceneError(f"{problem.source}: {error}") from error

    def _assemble(self) -> None:
        arena_tree = self._arena_tree()
        bodies = [self._load_entity(i.name, i.category, fixture=False) for i in self.problem.objects]
        bodies += [
            self._load_entity(i.name, i.category, fixture=True)
            for i in self.problem.fixtures
            if i.category != self.arena.workspace_category
        ]
        table = mjcf.body(arena_tree, self.arena.table_body)
        for region in self.problem.regions:
            self._add_region(region, table, [tree for tree, _ in bodies])
        mjcf.merge(self.root, arena_tree)
        mjcf.merge(self.root, elements.robot(self.robosuite, self.arena))
        world = mjcf.section(self.root, "worldbody")
        for tree, source in bodies:
            mjcf.merge_assets(self.root, source)
            world.append(tree)

    def add_contact_sensors(self, pairs: Iterable[tuple[str, str]]) -> None:
        sensors = mjcf.section(self.root, "sensor")
        for first, second in sorted({(min(pair), max(pair)) for pair in pairs}):
            missing = [name for name in (first, second) if name not in self.entities]
            if missing:
                raise SceneError(f"{self.problem.source}: no object or fixture {missing[0]!r} to sense contacts of")
            attributes = {"name": contact_sensor_name(first, second), "num": "1", "data": "found", "reduce": "none"}
            bodies = (self.entities[first].root_body, self.entities[second].root_body)
            ET.SubElement(sensors, "contact", {**attributes, "subtree1": bodies[0], "subtree2": bodies[1]})

    def _arena_tree(self) -> ET.Element:
        root = mjcf.load(self.libero / self.arena.scene_xml)
        if self.arena.table is not None:
            elements.resize_table(root, self.arena)
        elements.set_textures(root, self.arena)
        world = mjcf.section(root, "worldbody")
        for camera in self.arena.cameras:
            element = world.find(f"camera[@name='{camera.name}']")
            if element is None:
                element = ET.SubElement(world, "camera", {"name": camera.name})
            element.set("pos", mjcf.text(camera.pos))
            element.set("quat", mjcf.text(camera.quat))
        return root

    def _load_entity(self, name: str, category: str, *, fixture: bool) -> tuple[ET.Element, ET.Element]:
        path = catalog.asset_file(category, self.libero)
        source = mjcf.load(path)
        tree = mjcf.object_subtree(source, name, free=not fixture, path=path)
        mjcf.add_prefix(mjcf.section(source, "asset"), f"{name}_")
        self.entities[name] = Entity(
            name=name,
            category=category,
            fixture=fixture,
            root_body=tree.attrib["name"],
            joints=tuple(joint.attrib["name"] for joint in tree.iter("joint")),
            contact_geoms=tuple(g.attrib["name"] for g in tree.iter("geom") if g.get("group", "0") == "0"),
            bottom_z=_outer_site(source, "bottom_site")[2],
            top_z=_outer_site(source, "top_site")[2],
            radius=_outer_site(source, "horizontal_radius_site")[0],
        )
        return tree, source

    def _add_region(self, region: Region, table: ET.Element, trees: list[ET.Element]) -> None:
        if self.arena.workspace in region.name:
            self.regions[region.name] = zone = zone_site(region, self.arena)
            ET.SubElement(
                table,
                "site",
                {
                    "name": zone.name,
                    "type": "box",
                    "pos": mjcf.text(zone.pos),
                    "size": mjcf.text(zone.size),
                    "rgba": mjcf.text(region.rgba),
                },
            )
            return
        for entity, tree in zip(self.entities.values(), trees, strict=True):
            found = _find_region_site(tree, region.name, entity.name)
            if found is not None:
                self.regions[region.name] = found


def zone_site(region: Region, arena: Arena) -> RegionSite:
    """The site of a rectangular region on the table or floor (upstream's ``TargetZone`` of its first rectangle).

    Raises:
        SceneError: the region has no rectangle.
    """
    if not region.ranges:
        raise SceneError(f"region {region.name!r} lies on {arena.workspace} but gives no rectangle (:ranges)")
    x0, y0, x1, y1 = region.ranges[0]
    dx, dy, dz = arena.zone_offset
    return RegionSite(
        name=region.name,
        parent=None,
        joints=(),
        size=((x1 - x0) / 2, (y1 - y0) / 2, _ZONE_HALF_HEIGHT),
        pos=((x1 + x0) / 2 + dx, (y1 + y0) / 2 + dy, dz),
        body=arena.table_body,
    )


def _find_region_site(tree: ET.Element, name: str, entity: str) -> RegionSite | None:
    """The site called ``name`` as upstream finds it: bodies in document order, up to the first without any site.

    The last body that contains the site, which is the innermost, lends its joints.
    """
    found = None
    # Upstream reads the file before the free joint and the default site are added, so neither counts here.
    added = {f"{entity}_default_site", f"{entity}_joint0"}
    for part in tree.iter("body"):
        sites = [site for site in part.iter("site") if site.get("name") not in added]
        if not sites:
            break
        joints = tuple(j.attrib["name"] for j in part.findall("joint") if j.attrib["name"] not in added)
        for site in sites:
            if site.get("name") == name:
                size = mjcf.numbers(site.attrib["size"])
                found = RegionSite(
                    name=name,
                    parent=entity,
                    joints=joints,
                    size=(size[0], size[1], size[2]),
                    pos=_vec3(site.get("pos", "0 0 0")),
                    body=part.attrib["name"],
                )
    return found


def _outer_site(source: ET.Element, name: str) -> tuple[float, float, float]:
    """Position of a site next to an object's body, which tells its extent; zeros where the file has none."""
    site = source.find(f"worldbody/body/site[@name='{name}']")
    return (0.0, 0.0, 0.0) if site is None else _vec3(site.attrib["pos"])


def _vec3(text: str) -> tuple[float, float, float]:
    x, y, z = mjcf.numbers(text)
    return x, y, z
