"""The making of a scenery: from the visual model of a scene to a small flat one that a ray tracer renders fast.

In: a scene compiled with its visual meshes. Out: ``Flattened``, an ``MjModel`` without joints whose bodies are those of
the physics model in the same order, all of them children of the world. It holds only what is drawn: no collision geoms,
no meshes or textures that no geom uses. Each other difference from the visual model has a reason:

* Ray tracers visit boxes around geoms, and a robot of fifty meshes has many. Meshes of a body without a texture are
  joined into one, and their colours into one small texture, the palette.
* GL lights corners and blends between them, so large triangles have no highlights.
* Sites that are drawn, such as a burner that glows, become geoms.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from vecenv.libero.render import culling, drawing, surfaces
from vecenv.libero.render.burners import hinges
from vecenv.libero.render.surfaces import RGB_ROLE, Corners, Look
from vecenv.libero.scene import catalog
from vecenv.libero.scene.scene import Scene

# The name of the texture that holds the colours of untextured meshes.
PALETTE = "palette"
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
# A surface whose triangles have edges of at least this length, metres, has no highlights in GL, which lights corners
# only.
_COARSE = 0.05
# MuJoCo draws the sites of the groups below this by default.
_SITE_GROUPS = 3


@dataclass(frozen=True, kw_only=True)
class Burner:
    """A geom that is drawn while a stove is on: while ``sign * qpos >= bound`` (or ``>``) of one of its knobs.

    Attributes:
        geom: its index. knobs: addresses in qpos. sign, bound, inclusive: the test.
    """

    geom: int
    knobs: tuple[int, ...]
    sign: float
    bound: float
    inclusive: bool


@dataclass(frozen=True, kw_only=True)
class Flattened:
    """A flat model and what its geoms stand for; attributes as in ``vecenv.libero.render.scenery.Scenery``."""

    model: mujoco.MjModel
    instances: tuple[str, ...]
    instance_of_geom: np.ndarray
    burners: tuple[Burner, ...]


def flatten(scene: Scene, *, texture_side: int, join: bool) -> Flattened:
    """The flat model of a scene.

    Args:
        scene: compiled with ``visual=True``.
        texture_side: longest side of a texture, texels.
        join: whether to join the untextured meshes of a body.
    """
    return _Flattening(scene, texture_side, join).result()


class _Flattening:
    """Builds the flat model's spec: palette, textures, materials, joined meshes."""

    def __init__(self, scene: Scene, texture_side: int, join: bool) -> None:
        self._scene, self._model, self._side, self._join = scene, scene.model, texture_side, join
        self._spec = _empty_spec(scene.model)
        self._bodies = [self._spec.worldbody]
        for body, (pos, quat) in enumerate(zip(*_layout(scene), strict=True)):
            if body > 0:
                name = self._model.body(body).name
                self._bodies.append(self._spec.worldbody.add_body(name=name, pos=pos, quat=quat))
        self._palette: dict[tuple[float, ...], int] = {}
        self._textures: dict[int, str] = {}
        self._materials: dict[Look, str] = {}
        self._joined: dict[tuple[int, Look], list[Corners]] = {}
        self._face_normals: dict[str, np.ndarray] = {}
        # By name of what is added: names of geoms survive compilation, indices do not.
        self._glows: dict[str, tuple[list[int], tuple[float, float, bool]]] = {}

    def result(self) -> Flattened:
        """Add everything and compile."""
        self._collect_palette()
        for geom in self._drawn_geoms():
            self._add_geom(geom)
        for number, ((body, look), parts) in enumerate(self._joined.items()):
            self._add_mesh(f"joined{number}", body, look, surfaces.concatenated(parts))
        self._add_sites()
        _add_cameras(self._model, self._bodies)
        _add_lights(self._model, self._bodies)
        model = self._spec.compile()
        self._set_normals(model)
        _tighten(model)
        of_body = drawing.instances_of_bodies(self._model, self._scene)
        return Flattened(
            model=model,
            instances=("", drawing.ROBOT, *self._scene.entities),
            instance_of_geom=of_body[model.geom_bodyid].astype(np.int16),
            burners=tuple(
                Burner(geom=model.geom(name).id, knobs=tuple(knobs), sign=sign, bound=bound, inclusive=inclusive)
                for name, (knobs, (sign, bound, inclusive)) in self._glows.items()
            ),
        )

    def _drawn_geoms(self) -> list[int]:
        model = self._model
        groups = np.isin(model.geom_group, culling.DRAWN_GROUPS)
        return [geom for geom in np.flatnonzero(groups).tolist() if surfaces.drawn_color(model, geom)[3] > 0]

    def _collect_palette(self) -> None:
        """Collect all colours first: the place of a colour in the palette depends on their number."""
        for geom in self._drawn_geoms():
            if self._joins(geom):
                self._palette.setdefault(surfaces.drawn_color(self._model, geom)[:3], len(self._palette))

    def _joins(self, geom: int) -> bool:
        model = self._model
        is_plain = int(model.geom_type[geom]) == _MESH and surfaces.texture_of(model, geom) < 0
        return self._join and is_plain and surfaces.drawn_color(model, geom)[3] == 1

    def _add_geom(self, geom: int) -> None:
        model, body = self._model, int(self._model.geom_bodyid[geom])
        kind, look = int(model.geom_type[geom]), surfaces.look_of(model, geom)
        if self._joins(geom):
            corners = surfaces.corners_of(model, geom)
            place = (self._palette[surfaces.drawn_color(model, geom)[:3]] + 0.5) / len(self._palette)
            corners.uv[:] = place, 0.5
            look = look._replace(color=None, repeat=(1.0, 1.0), uniform=False)
            self._joined.setdefault((body, look), []).append(corners)
        elif kind == _MESH:
            if model.mesh_texcoordadr[model.geom_dataid[geom]] < 0:
                look = look._replace(repeat=(1.0, 1.0), uniform=False)
            self._joined.setdefault((body, look), []).append(surfaces.corners_of(model, geom))
        else:
            pose = {"pos": model.geom_pos[geom], "quat": model.geom_quat[geom]}
            self._shape(body, kind, model.geom_size[geom], self._material(look), **pose)

    def _shape(self, body: int, kind: int, size: npt.ArrayLike, material: str, **more: object) -> None:
        self._bodies[body].add_geom(
            type=mujoco.mjtGeom(kind), size=size, material=material, group=1, contype=0, conaffinity=0, **more
        )

    def _add_mesh(self, name: str, body: int, look: Look, corners: Corners) -> None:
        if look.shininess > 0 and surfaces.mean_edge(corners) > _COARSE:
            look = look._replace(specular=0.0)
        arrays = {}
        for key, values in (("vert", corners.pos), ("normal", corners.normal), ("texcoord", corners.uv)):
            distinct, rows = _distinct(values.reshape(-1, values.shape[-1]))
            face = {"vert": "face", "normal": "facenormal", "texcoord": "facetexcoord"}[key]
            arrays[f"user{key}"], arrays[f"user{face}"] = distinct.ravel(), rows.ravel().astype(np.int32)
        self._face_normals[name] = arrays["userfacenormal"].reshape(-1, 3)
        mesh = self._spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        for field, array in arrays.items():
            setattr(mesh, field, array)
        self._shape(body, _MESH, np.zeros(3), self._material(look), meshname=name)

    def _set_normals(self, model: mujoco.MjModel) -> None:
        """Say again which normals the corners of triangles have: MuJoCo keeps the normals of a spec, but not that."""
        for name, rows in self._face_normals.items():
            mesh = model.mesh(name).id
            start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            assert (count, model.mesh_normalnum[mesh]) == (len(rows), rows.max() + 1)
            model.mesh_facenormal[start : start + count] = rows

    def _material(self, look: Look) -> str:
        if look not in self._materials:
            name = self._materials[look] = f"material{len(self._materials)}"
            material = self._spec.add_material(
                name=name,
                rgba=look.color or np.ones(4),
                specular=look.specular,
                shininess=look.shininess,
                emission=look.emission,
                reflectance=look.reflectance,
            )
            material.texrepeat, material.texuniform = np.array(look.repeat), look.uniform
            texture = self._palette_texture() if look.color is None else self._texture(look.texture)
            if texture:
                material.textures[RGB_ROLE] = texture
        return self._materials[look]

    def _palette_texture(self) -> str:
        if -1 not in self._textures:
            colors = np.rint(255 * np.array(list(self._palette))).astype(np.uint8)
            self._textures[-1] = self._add_texture(PALETTE, colors[None])
        return self._textures[-1]

    def _texture(self, index: int) -> str:
        if index < 0:
            return ""
        if index not in self._textures:
            self._textures[index] = self._add_texture(
                f"texture{index}", surfaces.texture_pixels(self._model, index, self._side)
            )
        return self._textures[index]

    def _add_texture(self, name: str, pixels: np.ndarray) -> str:
        height, width, channels = pixels.shape
        texture = self._spec.add_texture(
            name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=channels
        )
        texture.data = pixels.tobytes()
        return name

    def _add_sites(self) -> None:
        """Add the sites that GL draws: those that are always visible, and burners."""
        model, tests = self._model, _burners(self._model, self._scene)
        for site in _drawn_sites(model):
            name = f"site{site}"
            rgba = tuple(float(x) for x in model.site_rgba[site])
            look = Look(color=rgba)
            pose = {"pos": model.site_pos[site], "quat": model.site_quat[site]}
            kind, body = int(model.site_type[site]), int(model.site_bodyid[site])
            self._shape(body, kind, model.site_size[site], self._material(look), name=name, **pose)
            if site in tests:
                self._glows[name] = tests[site]


def _layout(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """About where bodies are, [nbody, 3] and wxyz [nbody, 4]: the robot as it starts, things side by side on the table.

    Ray tracers sort what they see into a tree by where it is in the model, and only stretch its boxes afterwards.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    pos = data.xpos.copy()
    side = int(np.ceil(np.sqrt(max(len(scene.entities), 1))))
    low, high = scene.workspace_bounds
    for number, entity in enumerate(scene.entities.values()):
        root = model.body(entity.root_body).id
        cell = np.array([number // side, number % side, 0]) + np.array([0.5, 0.5, 0])
        place = low + (high - low) * cell / side
        pos[model.body_rootid == root] += np.array([*place[:2], scene.base_z]) - data.xpos[root]
    return pos, data.xquat.copy()


def _tighten(model: mujoco.MjModel) -> None:
    """Give meshes frames whose boxes around the origin, by which ray tracers find them, are small: centred, and along
    the mesh's principal axes as MuJoCo leaves it, or its body's. Every mesh is of one geom.
    """
    for geom in np.flatnonzero(model.geom_type == _MESH):
        mesh, turn = int(model.geom_dataid[geom]), surfaces.matrix(model.geom_quat[geom])
        vert, normal = _rows(model, "vert", mesh), _rows(model, "normal", mesh)
        if _surface(np.ptp(vert @ turn.T, axis=0)) < _surface(np.ptp(vert, axis=0)):
            vert[:], normal[:] = vert @ turn.T, normal @ turn.T
            model.geom_quat[geom], turn = (1, 0, 0, 0), np.eye(3)
        middle = (vert.min(0) + vert.max(0)) / 2
        vert -= middle
        model.geom_pos[geom] += turn @ middle
        model.geom_size[geom] = np.abs(vert).max(0)


def _rows(model: mujoco.MjModel, name: str, mesh: int) -> np.ndarray:
    """A view of a mesh's vertices or normals."""
    start = getattr(model, f"mesh_{name}adr")[mesh]
    return getattr(model, f"mesh_{name}")[start : start + getattr(model, f"mesh_{name}num")[mesh]]


def _surface(sides: np.ndarray) -> float:
    return float(sides @ np.roll(sides, 1))


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows [m, k] that differ, of float32 rows [n, k], and which of them each row is, [n]."""
    rows = np.ascontiguousarray(rows + np.float32(0))  # no -0
    keys = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    _, first, which = np.unique(keys, return_index=True, return_inverse=True)
    return rows[first], which


def _drawn_sites(model: mujoco.MjModel) -> list[int]:
    shown = [
        group < _SITE_GROUPS and rgba[3] > 0 for group, rgba in zip(model.site_group, model.site_rgba, strict=True)
    ]
    return [site for site, is_seen in enumerate(shown) if is_seen and not _of_tool(model, site)]


def _of_tool(model: mujoco.MjModel, site: int) -> bool:
    return model.site(site).name.startswith(drawing.TOOL_SITES)


def _burners(model: mujoco.MjModel, scene: Scene) -> dict[int, tuple[list[int], tuple[float, float, bool]]]:
    """Sites that glow while their stove is on: addresses of its knobs, and sign, bound, inclusive of the test."""
    found = {}
    for entity in scene.entities.values():
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, f"{entity.name}_burner")
        turn_on = catalog.articulation(entity.category).turn_on
        if site >= 0 and turn_on is not None:
            found[site] = hinges(model, entity), turn_on.sign_form()
    return found


def _empty_spec(model: mujoco.MjModel) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.stat.extent, spec.stat.center = model.stat.extent, model.stat.center
    spec.visual.map.znear, spec.visual.map.zfar = model.vis.map.znear, model.vis.map.zfar
    head, source = spec.visual.headlight, model.vis.headlight
    head.ambient, head.diffuse, head.specular = source.ambient, source.diffuse, source.specular
    head.active = source.active
    return spec


def _add_cameras(model: mujoco.MjModel, bodies: list[mujoco.MjsBody]) -> None:
    for camera in range(model.ncam):
        if model.cam_mode[camera] == mujoco.mjtCamLight.mjCAMLIGHT_FIXED:
            bodies[model.cam_bodyid[camera]].add_camera(
                name=model.camera(camera).name,
                pos=model.cam_pos[camera],
                quat=model.cam_quat[camera],
                fovy=model.cam_fovy[camera],
            )


def _add_lights(model: mujoco.MjModel, bodies: list[mujoco.MjsBody]) -> None:
    for light in range(model.nlight):
        bodies[model.light_bodyid[light]].add_light(
            type=mujoco.mjtLightType(int(model.light_type[light])),
            active=bool(model.light_active[light]),
            castshadow=bool(model.light_castshadow[light]),
            pos=model.light_pos[light],
            dir=model.light_dir[light],
            ambient=model.light_ambient[light],
            diffuse=model.light_diffuse[light],
            specular=model.light_specular[light],
            attenuation=model.light_attenuation[light],
            cutoff=model.light_cutoff[light],
            exponent=model.light_exponent[light],
        )
