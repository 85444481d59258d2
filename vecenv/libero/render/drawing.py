"""From physics states to lists of things to draw: a scene's visual model, posed, seen by one camera, culled.

In: the visual model of a scene and the pose of one slot. Out: a filled ``MjvScene`` that any thread's GL context can
draw, and the camera's view. One ``Stage`` serves all threads: they take turns posing it, which takes well under a
millisecond, and draw in parallel.

What is drawn is what upstream draws (robosuite 1.4.0's offscreen renderer under LIBERO): visual geoms but no collision
geoms, no sites of the gripper, and a stove's burner while the stove is on.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import mujoco
import numpy as np

from vecenv.libero.render.colors import SKIN
from vecenv.libero.render.options import ALIASES, CameraShift, RenderError, UserCamera, VisualOptions, rotation_of
from vecenv.libero.scene import catalog
from vecenv.libero.scene.scene import Entity, Scene
from vecenv.observations import CameraView

# Groups that upstream draws: 1 holds visual geoms, 2 nothing; 0 are collision geoms. A culled geom moves to 5.
DRAWN_GROUPS, _HIDDEN = (1, 2), 5
# Upstream does not draw sites of these names.
TOOL_SITES = ("robot0_", "gripper0_")
ROBOT = "robot"
_ROBOT_BODIES = ("robot0_", "gripper0_", "mount0_")
# Spare entries for what MuJoCo adds to the model's geoms and sites.
_SPARE_GEOMS = 64
# Rays per side of the grid that tests whether the sky is visible.
_GRID = 17
_FONT = mujoco.mjtFontScale.mjFONTSCALE_50

_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
_CAMERA, _BODY = mujoco.mjtObj.mjOBJ_CAMERA, mujoco.mjtObj.mjOBJ_BODY


@dataclass(frozen=True)
class Pose:
    """One slot as its cameras see it: ``qpos`` [nq] and body poses in their parents ``body_pos``, ``body_quat``."""

    qpos: np.ndarray
    body_pos: np.ndarray
    body_quat: np.ndarray


@dataclass(frozen=True)
class View:
    """One camera of one slot: ``pos`` [3] in metres, ``mat`` [3, 3] (columns right, up, back), ``fovy`` in degrees."""

    pos: np.ndarray
    mat: np.ndarray
    fovy: float

    def shifted(self, shift: CameraShift) -> View:
        """The view moved in its own frame."""
        return View(
            self.pos + self.mat @ np.asarray(shift.pos, float),
            self.mat @ rotation_of(shift.turn),
            float(np.clip(self.fovy + shift.fovy, 1.0, 179.0)),
        )


def camera_view(views: Sequence[View], height: int, width: int) -> CameraView:
    """The contract's ``CameraView`` of a camera, from the views of B slots."""
    focal = np.array([height / 2 / np.tan(np.deg2rad(view.fovy) / 2) for view in views])
    matrices = np.zeros((len(views), 3, 3))
    # Delivered images are mirrored: x grows to the camera's left.
    matrices[:, 0, 0], matrices[:, 1, 1], matrices[:, 2, 2] = -focal, focal, 1.0
    matrices[:, 0, 2], matrices[:, 1, 2] = (width - 1) / 2, (height - 1) / 2
    # MuJoCo's camera axes are right, up, back; the contract's right, down, forward.
    rotations = np.stack([view.mat for view in views]) * np.array([1.0, -1.0, -1.0])
    return CameraView(intrinsics=matrices, pos=np.stack([view.pos for view in views]), mat=rotations)


class Viewpoints:
    """The cameras of a scene, which threads pose in turns.

    Args:
        model: any model of the scene; nothing else may use it.

    Attributes:
        model: the model.
        cameras: names of its cameras.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.cameras = _names(model, _CAMERA, model.ncam)
        self._data = mujoco.MjData(model)
        self._lock = threading.Lock()

    def view(self, camera: str | UserCamera, pose: Pose, options: VisualOptions, slot: int) -> View:
        """Where a camera of a slot is."""
        with self._lock:
            self._place(pose)
            return self._view(camera, options, slot)

    def _place(self, pose: Pose) -> None:
        model, data = self.model, self._data
        model.body_pos[:], model.body_quat[:], data.qpos[:] = pose.body_pos, pose.body_quat, pose.qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)  # cameras and lights may follow a body's centre of mass
        mujoco.mj_camlight(model, data)

    def _view(self, camera: str | UserCamera, options: VisualOptions, slot: int) -> View:
        if isinstance(camera, UserCamera):
            name, view = camera.name, View(*camera.in_slot(slot))
        else:
            name = ALIASES.get(camera, camera)
            index = self.cameras.index(name)
            mat = self._data.cam_xmat[index].reshape(3, 3).copy()
            view = View(self._data.cam_xpos[index].copy(), mat, float(self.model.cam_fovy[index]))
        for key in (name, *(alias for alias, real in ALIASES.items() if real == name)):
            if key in options.cameras:
                return view.shifted(options.cameras[key])
        return view


class Stage(Viewpoints):
    """The visual model of a scene, which threads pose in turns.

    Args:
        scene: compiled with ``visual=True``; nothing else may use its model.

    Attributes:
        model: the visual model.
        instances: the names that segmentation images index; "" (index 0) is everything else: table, floor, walls.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene.model)
        model = self.model
        self.instances = ("", ROBOT, *scene.entities)
        self._instance_of_body = instances_of_bodies(model, scene)
        self._groups, self._shine = model.geom_group.copy(), model.mat_reflectance.copy()
        # Only meshes are culled. Other shapes have few triangles, and Mesa's software driver sometimes smears a wall
        # behind the camera into the image: upstream's images have that, so these must too.
        self._always = model.geom_type != mujoco.mjtGeom.mjGEOM_MESH
        self._boxes, self._walls, self._mirrors = _Boxes(model), _Walls(model), _Mirrors(model)
        self._burners = _burners(model, scene)
        self._skins = np.array([model.geom(geom).name.startswith(SKIN) for geom in range(model.ngeom)], bool)
        for site in range(model.nsite):
            if model.site(site).name.startswith(TOOL_SITES):
                model.site_group[site] = _HIDDEN
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [group in DRAWN_GROUPS for group in range(mujoco.mjNGROUP)]

    def check_physics(self, physics: mujoco.MjModel) -> None:
        """Check that the poses of a physics model fit.

        Raises:
            RenderError: the model is of another scene.
        """
        model = self.model
        if _names(model, _BODY, model.nbody) != _names(physics, _BODY, physics.nbody) or model.nq != physics.nq:
            raise RenderError("the visual model and the physics model are not of the same scene")

    def context(self, height: int, width: int) -> mujoco.MjrContext:
        """The scene uploaded to this thread's GL context, with room for images of this size (about a second)."""
        with self._lock:
            self.model.vis.global_.offheight, self.model.vis.global_.offwidth = height, width
            context = mujoco.MjrContext(self.model, _FONT)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        return context

    def new_frame(self) -> mujoco.MjvScene:
        """An empty list of things to draw."""
        return mujoco.MjvScene(self.model, maxgeom=self.model.ngeom + self.model.nsite + _SPARE_GEOMS)

    def check(self, cameras: Sequence[str | UserCamera], options: VisualOptions) -> None:
        """Check that all names exist.

        Raises:
            RenderError: this scene does not have a camera, instance, material or texture.
        """
        for camera in (*cameras, *options.cameras):
            if isinstance(camera, str) and ALIASES.get(camera, camera) not in self.cameras:
                given = [other.name for other in cameras if isinstance(other, UserCamera)]
                if camera not in given:
                    raise RenderError(f"no camera {camera!r}; this scene has {', '.join((*self.cameras, *given))}")
        for name in options.colors:
            self._materials(name)
        for material, texture in options.textures.items():
            _id(self.model, mujoco.mjtObj.mjOBJ_MATERIAL, material)
            _id(self.model, mujoco.mjtObj.mjOBJ_TEXTURE, texture)

    def fill(
        self,
        frames: Sequence[mujoco.MjvScene],
        cameras: Sequence[str | UserCamera],
        pose: Pose,
        options: VisualOptions,
        *,
        slot: int,
        aspect: float,
    ) -> list[View]:
        """Fill one frame per camera with what it sees of a slot; ``aspect`` is the image's width over its height."""
        with self._lock:
            self._place(pose)
            with self._applied(options):
                return [
                    self._see(frame, self._view(camera, options, slot), aspect)
                    for frame, camera in zip(frames, cameras, strict=True)
                ]

    def segment(self, frame: mujoco.MjvScene, codes: np.ndarray) -> np.ndarray:
        """Instances, indices into ``instances``, int16 [H, W], of MuJoCo's segment codes [H, W] of a frame."""
        table = np.zeros(frame.ngeom + 2, np.int16)
        for geom in frame.geoms[: frame.ngeom]:
            if geom.segid >= 0:
                table[geom.segid + 1] = self._instance(geom.objtype, geom.objid)
        return table[np.where(codes < len(table), codes, 0)]

    @property
    def clip_planes(self) -> tuple[float, float]:
        """Distances between which things are drawn, metres."""
        visual = self.model.vis.map
        return visual.znear * self.model.stat.extent, visual.zfar * self.model.stat.extent

    def _place(self, pose: Pose) -> None:
        super()._place(pose)
        for site, knobs, is_on in self._burners:
            self.model.site_group[site] = 0 if any(is_on(self._data.qpos[knob]) for knob in knobs) else _HIDDEN

    def _see(self, frame: mujoco.MjvScene, view: View, aspect: float) -> View:
        """Fill a frame through the model's first camera, which is put where the view is and back."""
        model, data = self.model, self._data
        before = data.cam_xpos[0].copy(), data.cam_xmat[0].copy(), model.cam_fovy[0].copy()
        data.cam_xpos[0], data.cam_xmat[0], model.cam_fovy[0] = view.pos, view.mat.ravel(), view.fovy
        seen = self._seen(view, aspect)
        model.geom_group[:] = np.where(seen | self._always, self._groups, _HIDDEN)
        # MuJoCo draws everything once more for each mirror, also for one outside the image.
        model.mat_reflectance[:] = np.where(np.isin(np.arange(model.nmat), model.geom_matid[seen]), self._shine, 0)
        eye = mujoco.MjvCamera()
        eye.type, eye.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        mujoco.mjv_updateScene(model, data, self._option, None, eye, mujoco.mjtCatBit.mjCAT_ALL, frame)
        # The sky fills the whole image first, which costs as much as all walls.
        frame.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = not self._walls.fill(data, view, aspect)
        model.geom_group[:], model.mat_reflectance[:] = self._groups, self._shine
        data.cam_xpos[0], data.cam_xmat[0], model.cam_fovy[0] = before
        return view

    def _seen(self, view: View, aspect: float) -> np.ndarray:
        """Geoms that are in the image, or in a mirror that is, bool [ngeom]."""
        seen = self._boxes.in_sight(self._data, _Cone.of_image(view, aspect, self.clip_planes[0]))
        for cone in self._mirrors.cones(self._data, view, seen):
            seen = seen | self._boxes.in_sight(self._data, cone)
        return seen

    @contextmanager
    def _applied(self, options: VisualOptions) -> Iterator[None]:
        """Inside the context, the model and the posed data have the options' light, colours and textures."""
        if options == VisualOptions():
            yield
            return
        model, head = self.model, self.model.vis.headlight
        touched = [model.light_diffuse, model.light_ambient, model.light_specular, model.mat_rgba, model.geom_rgba]
        touched += [head.diffuse, head.ambient, head.specular, model.mat_texid, self._groups]
        before = [array.copy() for array in touched]
        scale = options.light * np.asarray(options.light_color, float)
        for light in (*touched[:3], *touched[5:8]):
            light *= scale
        self._data.light_xpos += np.asarray(options.light_shift, float)
        for name, color in options.colors.items():
            materials, geoms = self._materials(name)
            model.mat_rgba[materials, :3] *= np.asarray(color, float)
            model.geom_rgba[geoms, :3] *= np.asarray(color, float)
        for material, texture in options.textures.items():
            row = _id(model, mujoco.mjtObj.mjOBJ_MATERIAL, material)
            model.mat_texid[row, _RGB] = _id(model, mujoco.mjtObj.mjOBJ_TEXTURE, texture)
            # Skins fit the texture that was there; a cube texture would not fit them.
            self._groups[self._skins & (model.geom_matid == row)] = _HIDDEN
        try:
            yield
        finally:
            for array, value in zip(touched, before, strict=True):
                array[:] = value

    @functools.lru_cache(maxsize=256)  # noqa: B019 - a stage lives as long as its renderer
    def _materials(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Materials, and geoms without one, of an instance; or the material of this name."""
        model = self.model
        if name in self.instances[1:]:
            body = self._instance_of_body[model.geom_bodyid] == self.instances.index(name)
            geoms = np.flatnonzero(body & np.isin(self._groups, DRAWN_GROUPS))
            materials = np.unique(model.geom_matid[geoms])
            return materials[materials >= 0], geoms[model.geom_matid[geoms] < 0]
        material = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_MATERIAL, name)
        if material < 0:
            there = ", ".join(self.instances[1:])
            raise RenderError(f"no instance or material {name!r}; instances: {there}")
        return np.array([material]), np.zeros(0, int)

    def _instance(self, kind: int, index: int) -> int:
        if kind == mujoco.mjtObj.mjOBJ_GEOM:
            return int(self._instance_of_body[self.model.geom_bodyid[index]])
        if kind == mujoco.mjtObj.mjOBJ_SITE:
            return int(self._instance_of_body[self.model.site_bodyid[index]])
        return 0


@dataclass(frozen=True)
class _Cone:
    """The region that is visible from a point: points p with ``sides @ (p - apex) <= bounds``, world frame.

    The shapes are [S, 3], [3] and [S].
    """

    sides: np.ndarray
    apex: np.ndarray
    bounds: np.ndarray

    @classmethod
    def of_image(cls, view: View, aspect: float, near: float) -> _Cone:
        """The region beyond the near plane of a camera and between the sides of its image."""
        return cls(_side_normals(view, aspect), view.pos, np.array([-near, 0.0, 0.0, 0.0, 0.0]))


class _Boxes:
    """The bounding boxes of a model's geoms, for culling what a camera cannot see.

    MuJoCo draws everything, and what lies outside the image costs more than what is in it: software GL clips triangles
    one by one.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._center, self._half = model.geom_aabb[:, :3].copy(), model.geom_aabb[:, 3:].copy()
        # Planes are infinite; MuJoCo gives them the radius 0.
        self._endless = model.geom_rbound == 0

    def in_sight(self, data: mujoco.MjData, cone: _Cone) -> np.ndarray:
        """Geoms whose box is not wholly outside one side of a cone, bool [ngeom]."""
        turn = data.geom_xmat.reshape(-1, 3, 3)
        center = data.geom_xpos + np.einsum("nij,nj->ni", turn, self._center)
        reach = np.einsum("nk,snk->sn", self._half, np.abs(np.einsum("si,nij->snj", cone.sides, turn)))
        distance = cone.sides @ (center - cone.apex).T
        return self._endless | (distance - reach <= cone.bounds[:, None]).all(axis=0)


class _Mirrors:
    """The reflecting planes and boxes of a model; MuJoCo reflects in the upper side of a box."""

    def __init__(self, model: mujoco.MjModel) -> None:
        flat = np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE))
        shine = np.where(model.geom_matid >= 0, model.mat_reflectance[model.geom_matid], 0.0)
        self._geoms = np.flatnonzero(flat & (shine > 0) & np.isin(model.geom_group, DRAWN_GROUPS))
        self._half = model.geom_size[self._geoms].copy()
        self._half[model.geom_type[self._geoms] == mujoco.mjtGeom.mjGEOM_PLANE, 2] = 0

    def cones(self, data: mujoco.MjData, view: View, seen: np.ndarray) -> Iterator[_Cone]:
        """What the visible mirrors show: the region seen from the camera's mirror image through the mirror's edges."""
        for geom, half in zip(self._geoms, self._half, strict=True):
            turn = data.geom_xmat[geom].reshape(3, 3)
            normal, middle = turn[:, 2], data.geom_xpos[geom] + turn[:, 2] * half[2]
            height = normal @ (view.pos - middle)
            if not seen[geom] or height <= 0:
                continue
            apex = view.pos - 2 * height * normal
            sides, bounds = [-normal], [-height]
            if (half[:2] > 0).all():  # otherwise the mirror is infinite
                corners = middle + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half[:2] @ turn[:, :2].T
                # Edges in turn around +z, seen from below it.
                sides += list(np.cross(np.roll(corners, -1, axis=0) - apex, corners - apex))
                bounds += [0.0] * 4
            yield _Cone(np.array(sides), apex, np.array(bounds))


class _Walls:
    """The opaque, immovable boxes and planes of a model, for leaving out a sky that they hide."""

    def __init__(self, model: mujoco.MjModel) -> None:
        flat = np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE))
        alpha = np.where(model.geom_matid >= 0, model.mat_rgba[model.geom_matid, 3], model.geom_rgba[:, 3])
        still = model.body_weldid[model.geom_bodyid] == 0
        self._geoms = np.flatnonzero(flat & still & np.isin(model.geom_group, DRAWN_GROUPS) & (alpha == 1))
        half = model.geom_size[self._geoms].copy()
        planes = model.geom_type[self._geoms] == mujoco.mjtGeom.mjGEOM_PLANE
        # A plane whose size is 0 is infinite; its third size is the spacing of MuJoCo's grid.
        half[planes] = np.where(half[planes] > 0, half[planes], np.inf)
        half[planes, 2] = 0
        self._half, self._is_plane = half, planes

    def fill(self, data: mujoco.MjData, view: View, aspect: float) -> bool:
        """Whether all of a grid of rays over the image, its corners included, end at a wall."""
        rays = _image_rays(view, aspect)
        turn = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        eye = np.einsum("nji,nj->ni", turn, view.pos - data.geom_xpos[self._geoms])[:, None]
        way = rays @ turn
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(-self._half[:, None] - eye) / way, (self._half[:, None] - eye) / way])
        # Rays along a face give NaN, which fmin and fmax ignore.
        first, last = np.fmax.reduce(ends.min(axis=0), axis=-1), np.fmin.reduce(ends.max(axis=0), axis=-1)
        # GL draws front faces only: no box from inside, no plane from below.
        front = ~self._is_plane[:, None] | (eye[..., 2] > 0)
        return bool(((first <= last) & (first > 0) & front).any(axis=0).all())


def _image_rays(view: View, aspect: float) -> np.ndarray:
    """Directions from the camera to a grid of points over its image, world frame, [rays, 3]."""
    up = np.tan(np.deg2rad(view.fovy) / 2) * np.linspace(-1, 1, _GRID)
    x, y = np.meshgrid(up * aspect, up)
    return np.stack([x.ravel(), y.ravel(), -np.ones(x.size)], axis=1) @ view.mat.T


def _side_normals(view: View, aspect: float) -> np.ndarray:
    """Outward unit normals of near plane, left, right, bottom and top of what a camera sees, world frame, [5, 3]."""
    up = np.tan(np.deg2rad(view.fovy) / 2)
    side = up * aspect
    own = np.array([[0, 0, 1], [-1, 0, side], [1, 0, side], [0, -1, up], [0, 1, up]], float)
    return (own / np.linalg.norm(own, axis=1, keepdims=True)) @ view.mat.T


def instances_of_bodies(model: mujoco.MjModel, scene: Scene) -> np.ndarray:
    """Index of the instance that each body belongs to, 0 for none, int [nbody]."""
    roots = {entity.root_body: number for number, entity in enumerate(scene.entities.values(), start=2)}
    found = np.zeros(model.nbody, int)
    for body in range(1, model.nbody):
        name = model.body(body).name
        own = 1 if name.startswith(_ROBOT_BODIES) else roots.get(name, 0)
        found[body] = own or found[model.body_parentid[body]]
    return found


def _burners(model: mujoco.MjModel, scene: Scene) -> list[tuple[int, list[int], Callable[[float], bool]]]:
    """Sites that glow while their stove is on: site, addresses of its knobs in qpos, and the test for being on."""
    found = []
    for entity in scene.entities.values():
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, f"{entity.name}_burner")
        turn_on = catalog.articulation(entity.category).turn_on
        if site >= 0 and turn_on is not None:
            found.append((site, hinges(model, entity), _passes(turn_on)))
    return found


def hinges(model: mujoco.MjModel, entity: Entity) -> list[int]:
    """Addresses in qpos of the hinges of an entity."""
    joints = [model.joint(name) for name in entity.joints]
    return [int(joint.qposadr[0]) for joint in joints if joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE]


def _passes(test: catalog.JointTest) -> Callable[[float], bool]:
    sign, bound, inclusive = test.sign_form()
    return lambda qpos: sign * qpos >= bound if inclusive else sign * qpos > bound


def _names(model: mujoco.MjModel, kind: mujoco.mjtObj, count: int) -> tuple[str, ...]:
    return tuple(mujoco.mj_id2name(model, kind, index) or "" for index in range(count))


def _id(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    found = mujoco.mj_name2id(model, kind, name)
    if found < 0:
        what = kind.name.removeprefix("mjOBJ_").lower()
        count = {"material": model.nmat, "texture": model.ntex}[what]
        raise RenderError(f"no {what} {name!r}; this scene has {', '.join(filter(None, _names(model, kind, count)))}")
    return found
