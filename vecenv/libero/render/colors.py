"""Textures as MuJoCo showed them when LIBERO was published; newer versions of MuJoCo show them differently.

In: a problem. Out: its scene compiled with visual meshes. With ``"published"`` images are those of MuJoCo 3.3.0, and
up to 3.3.2, under which LIBERO's demonstrations were rendered and its checkpoints scored; with ``"current"`` those of
the installed MuJoCo. What differs:

* Since 3.3.3, PNG files with an sRGB chunk are decoded, which makes them darker: the floor of three of LIBERO's six
  workspaces and two maps of a bottle. The changelog's remedy is ``colorspace="linear"``, which is what is done here.
* Since 3.12.0, boxes have texture coordinates of their own. Before, two-dimensional textures were projected along z,
  with the texture's corner in another place: LIBERO's walls, the sides of its stove, a cloth. Such boxes get a skin, a
  mesh just outside the faces that look different, with the earlier coordinates. Finite planes changed likewise; those
  of LIBERO, whose textures repeat a whole number of times, look the same. It has no other shapes with such textures.
* A mesh without texture coordinates has its texture along the axes of its inertia. The stove's burner plate is round,
  so it has no particular ones, and what MuJoCo makes of it differs between versions. It is turned to those of 3.3.0.

Physics never sees any of this.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import mujoco
import numpy as np

from vecenv.libero.render import lod
from vecenv.libero.render.options import check_colors, matrix_of, quat_of
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.scene import Scene, scene_source

# Prefix of the names of a skin's mesh and geom; the name or number of the box follows.
SKIN = "published_skin:"
# How far outside the box a skin is, metres: more than depth buffers confuse, less than is visible.
_GAP = 2e-6
# Meshes by the end of their name, and the orientation (wxyz, in the mesh's file) that MuJoCo 3.3.0 gives their frame.
_FRAMES = {"burnerplate": (0.2580847, 0.65832536, -0.2580847, 0.65832536)}
_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)


def visual_scene(problem: Problem, colors: str, level: str = "original") -> Scene:
    """Compile a problem's scene for GL to draw.

    Args:
        problem: a parsed LIBERO problem.
        colors: ``"published"`` or ``"current"``.
        level: of detail, see ``vecenv.libero.render.lod``.

    Raises:
        RenderError: ``colors`` is neither.
        SceneError: as ``compile_scene`` raises.
    """
    check_colors(colors)
    scene = scene_source(problem, visual=True).compile(_add_skins if colors == "published" else None)
    lod.simplify(scene.model, level)  # finds meshes by their content, so it comes before any is changed
    set_decoding(scene.model, colors)
    if colors == "published":
        _undo_repetition(scene.model)
        for mesh in range(scene.model.nmesh):
            for name, quat in _FRAMES.items():
                if scene.model.mesh(mesh).name.endswith(name):
                    _set_frame(scene.model, mesh, quat)
    return scene


def set_decoding(model: mujoco.MjModel, colors: str) -> None:
    """Set how the textures of a compiled model are decoded; MuJoCo before 3.3.3 decoded none.

    Raises:
        RenderError: ``colors`` is neither ``"published"`` nor ``"current"``.
    """
    check_colors(colors)
    if colors == "published":
        model.tex_colorspace[:] = mujoco.mjtColorSpace.mjCOLORSPACE_LINEAR


def _add_skins(spec: mujoco.MjSpec) -> None:
    for number, geom in enumerate(list(spec.geoms)):
        scale = _scale(spec, geom) if geom.type == mujoco.mjtGeom.mjGEOM_BOX else None
        if scale is not None and geom.group == 1:
            _add_skin(spec, geom, f"{SKIN}{geom.name or number}", scale)


def _scale(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> np.ndarray | None:
    """How often a geom's two-dimensional texture repeats along x and y, [2]; None if it has none."""
    material = spec.material(geom.material) if geom.material else None
    texture = spec.texture(material.textures[_RGB]) if material and material.textures[_RGB] else None
    if material is None or texture is None or texture.type != mujoco.mjtTexture.mjTEXTURE_2D:
        return None
    return np.asarray(material.texrepeat) * (np.asarray(geom.size[:2]) if material.texuniform else 1.0)


def _add_skin(spec: mujoco.MjSpec, box: mujoco.MjsGeom, name: str, scale: np.ndarray) -> None:
    """Put a mesh around the sides of a box, and over its top and bottom if the texture's corner is elsewhere there."""
    axes = [0, 1] if np.allclose((scale + 1) / 2 % 1, 0) or _is_mirror(spec, box) else [0, 1, 2]
    faces = [_face(axis, sign, spec.visual.quality.numquads) for axis, sign in itertools.product(axes, (-1, 1))]
    corners, normals = (np.concatenate(arrays) for arrays in zip(*faces, strict=True))
    # MuJoCo 3.3.0, render_gl3.c, settexture: what its two object planes make of a corner of the unit box.
    texcoord = corners[:, :2] * np.array([0.5, -0.5]) * scale - 0.5
    face = np.arange(len(corners), dtype=np.int32)
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert = (corners * box.size + normals * _GAP).ravel()
    mesh.usernormal, mesh.usertexcoord = normals.ravel(), texcoord.ravel()
    mesh.userface = mesh.userfacenormal = mesh.userfacetexcoord = face
    skin = box.parent.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=box.material, pos=box.pos, quat=box.quat
    )
    for field in ("type", "axisangle", "xyaxes", "zaxis", "euler"):
        setattr(skin.alt, field, getattr(box.alt, field))
    skin.rgba, skin.group, skin.contype, skin.conaffinity = box.rgba, box.group, 0, 0


def _is_mirror(spec: mujoco.MjSpec, box: mujoco.MjsGeom) -> bool:
    """Whether MuJoCo draws reflections in a box's top, which a skin would cover."""
    return spec.material(box.material).reflectance > 0


def _face(axis: int, sign: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """A face of the unit box as MuJoCo draws it, of ``count`` squares a side: corners and normals, [count^2 * 6, 3]."""
    normal = sign * np.eye(3)[axis]
    right = np.eye(3)[(axis + 1) % 3] if axis != 1 else np.eye(3)[0]
    up = np.cross(normal, right)
    steps = np.linspace(-1, 1, count + 1)
    squares = []
    for (x0, x1), (y0, y1) in itertools.product(itertools.pairwise(steps), repeat=2):
        # Corners in turn; GL halves a square between its second and its fourth.
        square = [normal + x * right + y * up for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
        squares += [square[corner] for corner in (0, 1, 3, 1, 2, 3)]
    return np.array(squares), np.tile(normal, (len(squares), 1))


def _undo_repetition(model: mujoco.MjModel) -> None:
    """Divide the texture coordinates of skins by the repetition, which GL multiplies those of meshes with."""
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH):
        if model.geom(geom).name.startswith(SKIN):
            mesh, material = int(model.geom_dataid[geom]), int(model.geom_matid[geom])
            size = model.geom_size[geom, :2] if model.mat_texuniform[material] else 1.0
            start = model.mesh_texcoordadr[mesh]
            rows = model.mesh_texcoord[start : start + model.mesh_texcoordnum[mesh]]
            rows /= model.mat_texrepeat[material] * size


def _set_frame(model: mujoco.MjModel, mesh: int, quat: Sequence[float]) -> None:
    """Rotate the frame of a mesh. Only the texture that is projected on it looks different afterwards."""
    turn = matrix_of(np.asarray(quat)).T @ matrix_of(model.mesh_quat[mesh])
    shape = lod.Mesh.of(model, mesh)
    shape.vert[:], shape.normal[:] = shape.vert @ turn.T, shape.normal @ turn.T
    low, high = shape.vert.min(axis=0), shape.vert.max(axis=0)
    for geom in np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_dataid == mesh)):
        model.geom_quat[geom] = quat_of(matrix_of(model.geom_quat[geom]) @ turn.T)
        model.geom_aabb[geom] = np.concatenate([low + high, high - low]) / 2
        model.geom_size[geom] = np.maximum(-low, high)
    model.mesh_quat[mesh] = quat
