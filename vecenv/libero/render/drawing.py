"""From physics states to lists of things to draw: a scene's visual model, posed, seen by one camera, culled.

In: the visual model of a scene and the pose of one slot. Out: a filled ``MjvScene`` that any thread's GL context can
draw, and the camera's view. One ``Stage`` serves all threads: they take turns posing it, which takes well under a
millisecond, and draw in parallel.

What is drawn is what upstream draws (robosuite 1.4.0's offscreen renderer under LIBERO): visual geoms but no collision
geoms, no sites of the gripper, and a stove's burner while the stove is on.
"""

from __future__ import annotations

import functools
import itertools
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import mujoco
import numpy as np

from vecenv.libero.render.burners import burners
from vecenv.libero.render.colors import SKIN
from vecenv.libero.render.culling import DRAWN_GROUPS, HIDDEN, Boxes, Cone, Mirrors, View, Walls
from vecenv.libero.render.options import ALIASES, RenderError, UserCamera, VisualOptions
from vecenv.libero.scene.scene import Scene

# Upstream does not draw sites of these names.
TOOL_SITES = ("robot0_", "gripper0_")
ROBOT = "robot"
_ROBOT_BODIES = ("robot0_", "gripper0_", "mount0_")
# Spare entries for what MuJoCo adds to the model's geoms and sites.
_SPARE_GEOMS = 64
# MuJoCo draws a geom in its material's colour while the geom's own is this, and blends what is less opaque than that.
_UNSET, _OPAQUE = np.array([0.5, 0.5, 0.5, 1.0]), 0.995
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
class Sight:
    """What there is to see for a camera of a slot. Items are the model's geoms, then its sites.

    Attributes:
        view: where the camera is.
        drawable: items that would be drawn if they were in sight, bool [items].
        shown: items that are drawn: those of the image and of its mirrors.
        in_image: without mirrors. reflected: those that the mirror shows, and shapes that are never culled.
        mirror, reflectance: the geom that reflects, -1 for none, and the part of the light.
        poses: positions and rotation matrices of items, world frame, [items, 12].
        is_opaque: whether nothing transparent is shown.
    """

    view: View
    drawable: np.ndarray
    shown: np.ndarray
    in_image: np.ndarray
    reflected: np.ndarray
    mirror: int
    reflectance: float
    poses: np.ndarray
    is_opaque: bool


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
        model.body_pos[:], model.body_quat[:], data.qpos[:] = pose.body_pos, pose.body_quat, self._shown(pose.qpos)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)  # cameras and lights may follow a body's centre of mass
        mujoco.mj_camlight(model, data)

    def _shown(self, qpos: np.ndarray) -> np.ndarray:
        """The joint positions that are drawn in place of some."""
        return qpos

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
        grid: positions of joints are rounded to multiples of this (metres, radians, parts of a unit quaternion) before
            they are drawn, so that an object at rest, which physics lets creep by nanometres, is drawn in one place.

    Attributes:
        model: the visual model.
        scene, grid: as given.
        instances: the names that segmentation images index; "" (index 0) is everything else: table, floor, walls.
        boxes: the bounding boxes of its items.
        has_shadows: whether a light casts shadows.
    """

    def __init__(self, scene: Scene, grid: float = 0.0) -> None:
        super().__init__(scene.model)
        self.scene, self.grid, model = scene, grid, self.model
        self.instances = ("", ROBOT, *scene.entities)
        self._instance_of_body = instances_of_bodies(model, scene)
        # Only meshes are culled. Other shapes have few triangles, and Mesa's software driver sometimes smears a wall
        # behind the camera into the image: upstream's images have that, so these must too.
        self._always = model.geom_type != mujoco.mjtGeom.mjGEOM_MESH
        self.boxes, self._walls, self._mirrors = Boxes(model), Walls(model), Mirrors(model)
        self._burners = burners(model, scene)
        self._skins = np.array([model.geom(geom).name.startswith(SKIN) for geom in range(model.ngeom)], bool)
        for site in range(model.nsite):
            if model.site(site).name.startswith(TOOL_SITES):
                model.site_group[site] = HIDDEN
        self._groups, self._site_groups = model.geom_group.copy(), model.site_group.copy()
        self._shine = model.mat_reflectance.copy()
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = [group in DRAWN_GROUPS for group in range(mujoco.mjNGROUP)]
        alpha = np.concatenate(
            [_alpha(model, model.geom_rgba, model.geom_matid), _alpha(model, model.site_rgba, model.site_matid)]
        )
        self._visible, self._panes = alpha > 0, (alpha > 0) & (alpha < _OPAQUE)
        self.has_shadows = bool(model.light_castshadow.any()) and model.vis.quality.shadowsize > 0

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

    def save_model(self, into: np.ndarray) -> None:
        """Write the model as MuJoCo's binary file, uint8 [``mujoco.mj_sizeModel(model)``]."""
        with self._lock:
            mujoco.mj_saveModel(self.model, None, into)

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
        choices: Sequence[Callable[[Sight], np.ndarray]] = (),
    ) -> list[Sight]:
        """Fill one frame per camera with what it sees of a slot; ``aspect`` is the image's width over its height.

        ``choices`` has a function per camera that says which of the items in sight its frame gets; without, all do.
        """
        with self._lock:
            self._place(pose)
            with self._applied(options):
                return [
                    self._see(frame, self._view(camera, options, slot), aspect, choose)
                    for frame, camera, choose in itertools.zip_longest(frames, cameras, choices)
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
            self._site_groups[site] = 0 if any(is_on(pose.qpos[knob]) for knob in knobs) else HIDDEN

    def _shown(self, qpos: np.ndarray) -> np.ndarray:
        return np.round(qpos / self.grid) * self.grid if self.grid else qpos

    def _see(
        self, frame: mujoco.MjvScene, view: View, aspect: float, choose: Callable[[Sight], np.ndarray] | None
    ) -> Sight:
        """Fill a frame through the model's first camera, which is put where the view is and back."""
        model, data = self.model, self._data
        before = data.cam_xpos[0].copy(), data.cam_xmat[0].copy(), model.cam_fovy[0].copy()
        data.cam_xpos[0], data.cam_xmat[0], model.cam_fovy[0] = view.pos, view.mat.ravel(), view.fovy
        seen, sight = self._sight(view, aspect)
        drawn = sight.shown if choose is None else choose(sight)
        model.geom_group[:] = np.where(drawn[: model.ngeom], self._groups, HIDDEN)
        model.site_group[:] = np.where(drawn[model.ngeom :], self._site_groups, HIDDEN)
        # MuJoCo draws everything once more for each mirror, also for one outside the image.
        materials = model.geom_matid[seen]
        model.mat_reflectance[:] = 0
        materials = materials[materials >= 0]
        model.mat_reflectance[materials] = self._shine[materials]
        eye = mujoco.MjvCamera()
        eye.type, eye.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        mujoco.mjv_updateScene(model, data, self._option, None, eye, mujoco.mjtCatBit.mjCAT_ALL, frame)
        # The sky fills the whole image first, which costs as much as all walls.
        frame.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = not self._walls.fill(data, view, aspect)
        model.geom_group[:], model.site_group[:] = self._groups, self._site_groups
        model.mat_reflectance[:] = self._shine
        data.cam_xpos[0], data.cam_xmat[0], model.cam_fovy[0] = before
        return sight

    def _sight(self, view: View, aspect: float) -> tuple[np.ndarray, Sight]:
        """Geoms that are in the image, or in a mirror that is, bool [ngeom], and what there is to see."""
        model, data = self.model, self._data
        in_image = self.boxes.in_sight(data, Cone.of_image(view, aspect, self.clip_planes[0]))
        mirrored = {geom: self.boxes.in_sight(data, cone) for geom, cone in self._mirrors.cones(data, view, in_image)}
        seen = np.any([in_image, *mirrored.values()], axis=0)
        mirror = self._mirrors.first(seen)
        # Where MuJoCo's mirror is outside the image or seen from behind, nothing is reflected: it draws no other.
        mirror = mirror if mirror in mirrored else -1
        reflected = mirrored.get(mirror, np.zeros_like(seen))
        shine = float(self._shine[model.geom_matid[mirror]]) if mirror >= 0 else 0.0
        there = np.isin(self._groups, DRAWN_GROUPS)
        sites = self._option.sitegroup[np.clip(self._site_groups, 0, mujoco.mjNGROUP - 1)].astype(bool)
        masks = [
            np.concatenate([there & (mask | self._always), sites]) & self._visible
            for mask in (np.ones_like(seen), seen, in_image, reflected)
        ]
        poses = np.concatenate(
            [np.concatenate([data.geom_xpos, data.site_xpos]), np.concatenate([data.geom_xmat, data.site_xmat])], axis=1
        )
        panes = (masks[1] & self._panes).any() or self._mirrors.from_behind(data, view, masks[1])
        return seen, Sight(view, *masks, mirror=mirror, reflectance=shine, poses=poses, is_opaque=not panes)

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
            self._groups[self._skins & (model.geom_matid == row)] = HIDDEN
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


def instances_of_bodies(model: mujoco.MjModel, scene: Scene) -> np.ndarray:
    """Index of the instance that each body belongs to, 0 for none, int [nbody]."""
    roots = {entity.root_body: number for number, entity in enumerate(scene.entities.values(), start=2)}
    found = np.zeros(model.nbody, int)
    for body in range(1, model.nbody):
        name = model.body(body).name
        own = 1 if name.startswith(_ROBOT_BODIES) else roots.get(name, 0)
        found[body] = own or found[model.body_parentid[body]]
    return found


def _alpha(model: mujoco.MjModel, rgba: np.ndarray, material: np.ndarray) -> np.ndarray:
    """The opacity that MuJoCo draws geoms or sites with: the material's unless they have their own colour."""
    is_set = (rgba != _UNSET).any(axis=1) | (material < 0)
    own = rgba[:, 3]
    return np.where(is_set, own, model.mat_rgba[material, 3]) if model.nmat else own.copy()


def _names(model: mujoco.MjModel, kind: mujoco.mjtObj, count: int) -> tuple[str, ...]:
    return tuple(mujoco.mj_id2name(model, kind, index) or "" for index in range(count))


def _id(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    found = mujoco.mj_name2id(model, kind, name)
    if found < 0:
        what = kind.name.removeprefix("mjOBJ_").lower()
        count = {"material": model.nmat, "texture": model.ntex}[what]
        raise RenderError(f"no {what} {name!r}; this scene has {', '.join(filter(None, _names(model, kind, count)))}")
    return found
