"""What a ray tracer needs of a scene: from the visual model of a scene to a small flat one.

In: a scene compiled with its visual meshes. Out: ``Scenery``, an ``MjModel`` without joints whose bodies are those of
the physics model in the same order, all of them children of the world; so the poses of a physics state, and nothing
else, place everything in it. It holds only what is drawn: no collision geoms, no meshes or textures that nothing wears.
Each difference from the visual model has a reason:

* Ray tracers visit boxes around geoms, and a robot of fifty meshes has many. Meshes of a body that wear no texture are
  joined into one, and their colours into one small texture, the palette.
* MuJoCo's GL averages a texture over the area that a pixel shows (mipmaps); MuJoCo Warp looks up one point. Textures
  are therefore reduced beforehand to about the size at which cameras see them.
* GL lights corners and blends between them, so large triangles have no highlights.
* Sites that are seen, a burner that glows, become geoms.
"""

from __future__ import annotations

import dataclasses
import json
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from vecenv.libero.render import drawing, lod
from vecenv.libero.render.colors import set_decoding
from vecenv.libero.render.options import RenderError, check_colors
from vecenv.libero.scene import catalog
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.scene import Scene, compile_scene

# Of the files; counts up when what is in them changes.
_VERSION = 3
# Longest side of a texture, texels.
TEXTURE_SIDE = 256
# MuJoCo draws a geom in its material's colour while the geom's own is this.
_UNSET = np.array([0.5, 0.5, 0.5, 1.0])
# The name of the texture that holds the colours of untextured meshes.
PALETTE = "palette"
_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)
_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
# A surface of triangles with edges from here on, metres, has no highlights in GL, which lights corners only.
_COARSE = 0.05
# Groups of sites that MuJoCo draws unless told otherwise are those below.
SITE_GROUPS = 3


@dataclass(frozen=True, kw_only=True)
class Burner:
    """A geom that is seen while a stove is on: while ``sign * qpos >= bound`` (or ``>``) of one of its knobs.

    Attributes:
        geom: its index. knobs: addresses in qpos. sign, bound, inclusive: the test.
    """

    geom: int
    knobs: tuple[int, ...]
    sign: float
    bound: float
    inclusive: bool


@dataclass(frozen=True, kw_only=True)
class Scenery:
    """What there is to see of a scene.

    Attributes:
        model: the flat model; its cameras and lights are the scene's.
        instances: what segmentation images tell apart; "" (index 0) is everything else.
        instance_of_geom: index into ``instances`` of each geom, int16 [ngeom].
        burners: geoms that are not always seen.
        colors: how textures look, see ``vecenv.libero.render.colors``.
    """

    model: mujoco.MjModel
    instances: tuple[str, ...]
    instance_of_geom: np.ndarray
    burners: tuple[Burner, ...] = ()
    colors: str = "published"

    def check(self, physics: mujoco.MjModel, colors: str | None = None) -> None:
        """See that poses of a physics model fit, and that it has these colours, if any are asked for.

        Raises:
            RenderError: it is not of the same scene, or has others.
        """
        if colors is not None and colors != self.colors:
            raise RenderError(
                f"the scenery was made with colors={self.colors!r} and colors={colors!r} is asked for; "
                f"make it anew with installed_scenery(problem, colors={colors!r}), or ask for colors={self.colors!r}"
            )
        names = [[model.body(body).name for body in range(model.nbody)] for model in (self.model, physics)]
        if names[0] != names[1]:
            raise RenderError("the scenery and the physics model are not of the same scene")

    def save(self, path: str | Path) -> None:
        """Write to a file that this version of MuJoCo can read."""
        buffer = np.zeros(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, buffer)
        about = {"version": _VERSION, "instances": self.instances, "colors": self.colors}
        text = np.array(json.dumps({**about, "burners": [vars(burner) for burner in self.burners]}))
        np.savez_compressed(path, model=buffer, about=text, instance_of_geom=self.instance_of_geom)

    @classmethod
    def load(cls, path: str | Path) -> Scenery:
        """Read what ``save`` wrote.

        Raises:
            OSError: the file cannot be read.
            RenderError: it is not such a file, or another MuJoCo or another version of vecenv wrote it.
        """
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        try:
            about = json.loads(str(arrays["about"]))
            model = mujoco.MjModel.from_binary_path("m", {"m": arrays["model"].tobytes()})
            burners = tuple(Burner(**{**burner, "knobs": tuple(burner["knobs"])}) for burner in about["burners"])
        except (KeyError, ValueError, TypeError) as error:
            raise RenderError(f"{path}: no scenery that MuJoCo {mujoco.__version__} can read") from error
        if about.get("version") != _VERSION:
            raise RenderError(f"{path}: a scenery of another version of vecenv; write it anew")
        return cls(
            model=model,
            instances=tuple(about["instances"]),
            instance_of_geom=arrays["instance_of_geom"],
            burners=burners,
            colors=str(about["colors"]),
        )


def scenery_of(
    scene: Scene,
    *,
    level: str = "fast",
    colors: str = "published",
    texture_side: int = TEXTURE_SIDE,
    join: bool = True,
) -> Scenery:
    """The scenery of a scene.

    Args:
        scene: compiled with ``visual=True``; its meshes are simplified in place.
        level: of detail, see ``vecenv.libero.render.lod``.
        colors: how textures look, ``"published"`` or ``"current"``, see ``vecenv.libero.render.colors``.
        texture_side: longest side of a texture, texels.
        join: whether to join the untextured meshes of a body.

    Raises:
        RenderError: ``colors`` is neither.
    """
    set_decoding(scene.model, colors)
    lod.simplify(scene.model, level)
    return dataclasses.replace(_Flattening(scene, texture_side, join).result(), colors=colors)


def installed_scenery(problem: Problem, level: str = "fast", colors: str = "published") -> Scenery:
    """The scenery of a problem's scene, compiled from the installed packages (10 s); errors of ``compile_scene``."""
    check_colors(colors)
    key = (problem.scene_key(), level, colors)
    scenery = _sceneries.get(key)
    if scenery is None:
        scenery = _sceneries[key] = scenery_of(compile_scene(problem, visual=True), level=level, colors=colors)
    return scenery


# Sceneries stay while something uses them.
_sceneries: weakref.WeakValueDictionary[tuple, Scenery] = weakref.WeakValueDictionary()


class _Look(NamedTuple):
    """What a surface is made of: texture (or -1), colour, repetition, and what MuJoCo's materials have besides.

    ``color`` None is for a palette. What has no material is of the defaults.
    """

    texture: int = -1
    color: tuple[float, ...] | None = None
    repeat: tuple[float, ...] = (1.0, 1.0)
    uniform: bool = False
    specular: float = 0.5
    shininess: float = 0.5
    emission: float = 0.0
    reflectance: float = 0.0


class _Corners(NamedTuple):
    """Triangles: ``pos`` and ``normal`` [n, 3, 3] in the body's frame, ``uv`` [n, 3, 2]."""

    pos: np.ndarray
    normal: np.ndarray
    uv: np.ndarray


class _Flattening:
    """The making of a scenery."""

    def __init__(self, scene: Scene, texture_side: int, join: bool) -> None:
        self._scene, self._model, self._side, self._join = scene, scene.model, texture_side, join
        self._spec = _empty_spec(scene.model)
        self._bodies = [self._spec.worldbody]
        for body, (pos, quat) in enumerate(zip(*_layout(scene), strict=True)):
            if body > 0:
                name = self._model.body(body).name
                self._bodies.append(self._spec.worldbody.add_body(name=name, pos=pos, quat=quat))
        self._palette: dict[tuple[float, ...], int] = {}
        self._images: dict[int, np.ndarray] = {}
        self._textures: dict[int, str] = {}
        self._materials: dict[_Look, str] = {}
        self._joined: dict[tuple[int, _Look], list[_Corners]] = {}
        # By name of what is added: names of geoms survive compilation, indices do not.
        self._glows: dict[str, tuple[list[int], tuple[float, float, bool]]] = {}

    def result(self) -> Scenery:
        """Everything added and compiled."""
        self._collect_palette()
        for geom in self._seen_geoms():
            self._add_geom(geom)
        for number, ((body, look), parts) in enumerate(self._joined.items()):
            self._add_mesh(f"joined{number}", body, look, _concatenated(parts))
        self._add_sites()
        _add_cameras(self._model, self._bodies)
        _add_lights(self._model, self._bodies)
        model = self._spec.compile()
        _tighten(model)
        of_body = drawing.instances_of_bodies(self._model, self._scene)
        return Scenery(
            model=model,
            instances=("", drawing.ROBOT, *self._scene.entities),
            instance_of_geom=of_body[model.geom_bodyid].astype(np.int16),
            burners=tuple(
                Burner(geom=model.geom(name).id, knobs=tuple(knobs), sign=sign, bound=bound, inclusive=inclusive)
                for name, (knobs, (sign, bound, inclusive)) in self._glows.items()
            ),
        )

    def _seen_geoms(self) -> list[int]:
        model = self._model
        groups = np.isin(model.geom_group, drawing.DRAWN_GROUPS)
        return [geom for geom in np.flatnonzero(groups).tolist() if _color(model, geom)[3] > 0]

    def _collect_palette(self) -> None:
        """All colours first: where a colour lies in the palette depends on how many there are."""
        for geom in self._seen_geoms():
            if self._joins(geom):
                self._palette.setdefault(_color(self._model, geom)[:3], len(self._palette))

    def _joins(self, geom: int) -> bool:
        model = self._model
        is_plain = int(model.geom_type[geom]) == _MESH and _texture(model, geom) < 0
        return self._join and is_plain and _color(model, geom)[3] == 1

    def _add_geom(self, geom: int) -> None:
        model, body = self._model, int(self._model.geom_bodyid[geom])
        kind, look = int(model.geom_type[geom]), _look(model, geom)
        if self._joins(geom):
            corners = _corners(model, geom)
            place = (self._palette[_color(model, geom)[:3]] + 0.5) / len(self._palette)
            corners.uv[:] = place, 0.5
            look = look._replace(color=None, repeat=(1.0, 1.0), uniform=False)
            self._joined.setdefault((body, look), []).append(corners)
        elif kind == _MESH:
            if model.mesh_texcoordadr[model.geom_dataid[geom]] < 0:
                look = look._replace(repeat=(1.0, 1.0), uniform=False)
            self._joined.setdefault((body, look), []).append(_corners(model, geom))
        else:
            pose = {"pos": model.geom_pos[geom], "quat": model.geom_quat[geom]}
            self._shape(body, kind, model.geom_size[geom], self._material(look), **pose)

    def _shape(self, body: int, kind: int, size: Any, material: str, **more: Any) -> None:
        self._bodies[body].add_geom(
            type=mujoco.mjtGeom(kind), size=size, material=material, group=1, contype=0, conaffinity=0, **more
        )

    def _add_mesh(self, name: str, body: int, look: _Look, corners: _Corners) -> None:
        if look.shininess > 0 and _edge(corners) > _COARSE:
            look = look._replace(specular=0.0)
        arrays = {}
        for key, values in (("vert", corners.pos), ("normal", corners.normal), ("texcoord", corners.uv)):
            distinct, rows = _distinct(values.reshape(-1, values.shape[-1]))
            face = {"vert": "face", "normal": "facenormal", "texcoord": "facetexcoord"}[key]
            arrays[f"user{key}"], arrays[f"user{face}"] = distinct.ravel(), rows.ravel().astype(np.int32)
        mesh = self._spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        for key, array in arrays.items():
            setattr(mesh, key, array)
        self._shape(body, _MESH, np.zeros(3), self._material(look), meshname=name)

    def _material(self, look: _Look) -> str:
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
                material.textures[_RGB] = texture
        return self._materials[look]

    def _palette_texture(self) -> str:
        if -1 not in self._textures:
            colors = np.rint(255 * np.array(list(self._palette))).astype(np.uint8)
            self._textures[-1] = self._add_texture(PALETTE, colors[None])
        return self._textures[-1]

    def _image(self, index: int) -> np.ndarray:
        if index not in self._images:
            self._images[index] = _pixels(self._model, index, self._side)
        return self._images[index]

    def _texture(self, index: int) -> str:
        if index < 0:
            return ""
        if index not in self._textures:
            self._textures[index] = self._add_texture(f"texture{index}", self._image(index))
        return self._textures[index]

    def _add_texture(self, name: str, pixels: np.ndarray) -> str:
        height, width, channels = pixels.shape
        texture = self._spec.add_texture(
            name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=channels
        )
        texture.data = pixels.tobytes()
        return name

    def _add_sites(self) -> None:
        """What GL draws of sites: those that are always seen, and burners."""
        model, tests = self._model, _burners(self._model, self._scene)
        for site in _seen_sites(model):
            name = f"site{site}"
            rgba = tuple(float(x) for x in model.site_rgba[site])
            look = _Look(color=rgba)
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
        mesh, turn = int(model.geom_dataid[geom]), _matrix(model.geom_quat[geom])
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


def _matrix(quat: np.ndarray) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quat)
    return out.reshape(3, 3)


def _surface(sides: np.ndarray) -> float:
    return float(sides @ np.roll(sides, 1))


def _seen_sites(model: mujoco.MjModel) -> list[int]:
    shown = [group < SITE_GROUPS and rgba[3] > 0 for group, rgba in zip(model.site_group, model.site_rgba, strict=True)]
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
            found[site] = drawing.hinges(model, entity), turn_on.sign_form()
    return found


def _empty_spec(model: mujoco.MjModel) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.stat.extent, spec.stat.center = model.stat.extent, model.stat.center
    spec.visual.map.znear, spec.visual.map.zfar = model.vis.map.znear, model.vis.map.zfar
    head, source = spec.visual.headlight, model.vis.headlight
    head.ambient, head.diffuse, head.specular = source.ambient, source.diffuse, source.specular
    head.active = source.active
    return spec


def _add_cameras(model: mujoco.MjModel, bodies: list[Any]) -> None:
    for camera in range(model.ncam):
        if model.cam_mode[camera] == mujoco.mjtCamLight.mjCAMLIGHT_FIXED:
            bodies[model.cam_bodyid[camera]].add_camera(
                name=model.camera(camera).name,
                pos=model.cam_pos[camera],
                quat=model.cam_quat[camera],
                fovy=model.cam_fovy[camera],
            )


def _add_lights(model: mujoco.MjModel, bodies: list[Any]) -> None:
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


def _areas(triangles: np.ndarray) -> np.ndarray:
    """Areas [n] of triangles [n, 3, 3]."""
    sides = np.diff(triangles.astype(float), axis=1)
    return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2


def drawn_colors(model: mujoco.MjModel) -> np.ndarray:
    """Red, green, blue, alpha that geoms are drawn in (times their textures), float32 [ngeom, 4]."""
    return np.array([_color(model, geom) for geom in range(model.ngeom)], np.float32).reshape(-1, 4)


def _color(model: mujoco.MjModel, geom: int) -> tuple[float, ...]:
    """Red, green, blue, alpha that a geom is drawn in (times its texture)."""
    own, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    chosen = model.mat_rgba[material] if material >= 0 and np.allclose(own, _UNSET) else own
    return tuple(float(x) for x in chosen)


def _texture(model: mujoco.MjModel, geom: int) -> int:
    material = int(model.geom_matid[geom])
    return int(model.mat_texid[material, _RGB]) if material >= 0 else -1


def _look(model: mujoco.MjModel, geom: int) -> _Look:
    material, color = int(model.geom_matid[geom]), _color(model, geom)
    if material < 0:
        return _Look(color=color)
    return _Look(
        texture=_texture(model, geom),
        color=color,
        repeat=tuple(model.mat_texrepeat[material].tolist()),
        uniform=bool(model.mat_texuniform[material]),
        specular=float(model.mat_specular[material]),
        shininess=float(model.mat_shininess[material]),
        emission=float(model.mat_emission[material]),
        reflectance=float(model.mat_reflectance[material]),
    )


def _corners(model: mujoco.MjModel, geom: int) -> _Corners:
    """The triangles of a mesh geom in its body's frame."""
    mesh, turn = lod.Mesh.of(model, int(model.geom_dataid[geom])), _matrix(model.geom_quat[geom])
    pos = mesh.vert[mesh.face] @ turn.T + model.geom_pos[geom]
    normal = mesh.normal[mesh.face_normal] @ turn.T
    uv = mesh.texcoord[mesh.face_texcoord] if len(mesh.texcoord) else _projected(model, geom, mesh)
    return _Corners(pos.astype(np.float32), normal.astype(np.float32), uv.astype(np.float32))


def _projected(model: mujoco.MjModel, geom: int, mesh: lod.Mesh) -> np.ndarray:
    """Texture coordinates, repetition included, [n, 3, 2], that MuJoCo gives meshes without any: seen from above."""
    material = int(model.geom_matid[geom])
    repeat = model.mat_texrepeat[material] if material >= 0 else np.ones(2)
    size = np.ones(2) if material >= 0 and model.mat_texuniform[material] else model.geom_size[geom, :2]
    return mesh.vert[mesh.face][..., :2] * np.array([0.5, -0.5]) * repeat / np.maximum(size, 1e-9) - 0.5


def _edge(corners: _Corners) -> float:
    """Length of the edges of triangles, metres, as seen on average over their surface."""
    area = _areas(corners.pos)
    return float(np.average(np.sqrt(area), weights=area)) if area.sum() > 0 else 0.0


def _concatenated(parts: list[_Corners]) -> _Corners:
    return _Corners(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows [m, k] that differ, of float32 rows [n, k], and which of them each row is, [n]."""
    rows = np.ascontiguousarray(rows + np.float32(0))  # no -0
    keys = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    _, first, which = np.unique(keys, return_index=True, return_inverse=True)
    return rows[first], which


def _pixels(model: mujoco.MjModel, index: int, side: int) -> np.ndarray:
    """A texture, uint8 [h, w, 3], averaged to at most ``side`` texels a side."""
    height, width, channels = model.tex_height[index], model.tex_width[index], model.tex_nchannel[index]
    start = model.tex_adr[index]
    pixels = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)[..., :3]
    if model.tex_type[index] == mujoco.mjtTexture.mjTEXTURE_CUBE and height == 6 * width:
        pixels = pixels[:width]
    linear = _reduced(_reduced(_halved(pixels, 2 * side), side, 0), side, 1) / 255
    if model.tex_colorspace[index] == mujoco.mjtColorSpace.mjCOLORSPACE_SRGB:
        linear = np.where(linear <= 0.04045, linear / 12.92, ((linear + 0.055) / 1.055) ** 2.4)
    return np.rint(255 * linear).astype(np.uint8)


def _halved(image: np.ndarray, side: int) -> np.ndarray:
    """Float32 of an image [h, w, c], whole blocks averaged while both sides are at least twice ``side``."""
    step = max(1, min(image.shape[:2]) // side)
    height, width = image.shape[0] // step, image.shape[1] // step
    blocks = image[: height * step, : width * step].reshape(height, step, width, step, -1)
    return blocks.mean((1, 3), dtype=np.float32)


def _reduced(image: np.ndarray, side: int, axis: int) -> np.ndarray:
    """Averaged along an axis to at most ``side`` entries."""
    size = image.shape[axis]
    if size <= side:
        return image
    sums = np.cumsum(image, axis=axis, dtype=np.float64)
    sums = np.concatenate([np.zeros_like(np.take(sums, [0], axis)), sums], axis=axis)
    edges = np.linspace(0, size, side + 1)
    low = np.minimum(edges.astype(int), size - 1)
    part = (edges - low).reshape([-1 if a == axis else 1 for a in range(image.ndim)])
    at = np.take(sums, low, axis) * (1 - part) + np.take(sums, low + 1, axis) * part
    return (np.diff(at, axis=axis) * (side / size)).astype(np.float32)
