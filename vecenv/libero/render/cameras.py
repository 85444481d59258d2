"""The cameras of a batch: they capture the poses of one moment, and render images of it when an image is read.

In: the physics groups of a batch and the problem that each of them runs. Out: the image mappings of ``Egocentric``. A
capture copies the poses it needs, so its images do not change when the batch moves on. Nothing is compiled, uploaded or
drawn before an image is read, and no GL library is loaded before that.
"""

from __future__ import annotations

import copy
import functools
import threading
import time
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, NoReturn

import jax
import mujoco
import numpy as np

from vecenv.libero.physics.base import Group
from vecenv.libero.render import lod
from vecenv.libero.render.drawing import ROBOT, Pose, Stage, Viewpoints
from vecenv.libero.render.gl import Frames, GlError, GlRenderer, Shot, Wanted
from vecenv.libero.render.jobs import camera_view
from vecenv.libero.render.options import ALIASES, RenderConfig, RenderError, UserCamera, VisualOptions
from vecenv.libero.render.sources import InstalledVisuals, VisualSource
from vecenv.libero.scene.bddl import Problem
from vecenv.observations import CameraView, Rendered, choose_cameras
from vecenv.util import inputs
from vecenv.util.transfers import fetch

if TYPE_CHECKING:
    from vecenv.libero.render.rays import RayRenderer

_StageKey = tuple[object, str, str]
_INSTALLED = InstalledVisuals()
# How many stages stay compiled after the last environment that used them is closed; one takes 0.9 GB.
_KEPT = 1
_stages: weakref.WeakValueDictionary[_StageKey, Stage] = weakref.WeakValueDictionary()
_kept: OrderedDict[_StageKey, Stage] = OrderedDict()
_compiling = threading.Lock()


def stage_of(
    problem: Problem, physics: mujoco.MjModel, level: str, colors: str, source: VisualSource = _INSTALLED
) -> Stage:
    """The stage of a problem's scene; errors are those of the source: ``compile_scene``'s, or ``ExportError``.

    Compiling takes seconds. A stage is reused while an environment uses it, and the last one used is kept.
    """
    key = (source.key(problem), level, colors)
    with _compiling:
        stage = _stages.get(key)
        if stage is None:
            scene = source.scene(problem, level=level, colors=colors)
            mujoco.mj_clearCache(mujoco.mj_getCache())  # 0.37 GB of decoded files
            stage = _stages[key] = Stage(scene, lod.GRID[level])
        _kept[key] = stage
        _kept.move_to_end(key)
        while len(_kept) > _KEPT:
            _kept.popitem(last=False)
    stage.check_physics(physics)
    return stage


class CameraRig:
    """The cameras of a batch.

    Args:
        config: how to render.
        num_envs: slots, B.
        chosen: the cameras that captures show; None for all.
        source: where what is drawn comes from.

    Attributes:
        seconds: time spent rendering so far.
    """

    def __init__(
        self,
        config: RenderConfig,
        num_envs: int,
        chosen: Sequence[str] | None = None,
        source: VisualSource = _INSTALLED,
    ) -> None:
        self.config, self._chosen, self._source = config, chosen, source
        self.options: list[VisualOptions] = [VisualOptions()] * num_envs
        self._renderer: GlRenderer | None = None
        self._rays: RayRenderer | None = None
        self._stages: list[Stage] = []
        self._closed = False
        self.seconds = 0.0

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Add the time spent inside to ``seconds``."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds += time.perf_counter() - started

    def names(self, models: Sequence[mujoco.MjModel]) -> tuple[str, ...]:
        """The cameras that captures of scenes with these models show.

        Raises:
            UnknownCamera: one that was chosen is not in all of them.
            RenderError: a user camera has the name of a scene's.
        """
        there = _camera_names(models, self.config.cameras)
        return there if self._chosen is None else choose_cameras(self._chosen, there)

    def capture(self, groups: Sequence[Group], problems: Sequence[Problem], slots: np.ndarray) -> Capture:
        """Capture the poses of now; ``problems`` has one for each group, ``slots`` the indices of those to draw."""
        return Capture(self, groups, problems, slots)

    def stages(self, problems: Sequence[Problem], models: Sequence[mujoco.MjModel]) -> list[Stage]:
        """The stages of these problems, one physics model for each; they are kept until others are requested.

        Raises:
            GlError: the environment is closed.
        """
        if self._closed:
            raise GlError("the environment is closed: images must be read before")
        pairs = zip(problems, models, strict=True)
        look = self.config.lod, self.config.colors, self._source
        self._stages = [stage_of(problem, model, *look) for problem, model in pairs]
        return self._stages

    def renderer(self, stages: Sequence[Stage]) -> GlRenderer:
        """A renderer of these stages, kept until others are requested; one whose processes draw is kept then, too.

        Raises:
            GlError: there is no GL.
        """
        if self._renderer is not None and self._renderer.stages != tuple(stages) and not self._renderer.use(stages):
            self._drop()
        if self._renderer is None:
            self._renderer = GlRenderer(
                stages,
                height=self.config.height,
                width=self.config.width,
                num_threads=self.config.num_threads,
                num_processes=self.config.num_processes,
                gl=self.config.gl,
            )
        return self._renderer

    def rays(self) -> RayRenderer:
        """The ray tracer.

        Raises:
            GlError: the environment is closed.
        """
        if self._closed:
            raise GlError("the environment is closed: images must be read before")
        if self._rays is None:
            from vecenv.libero.render.rays import RayRenderer  # needs the extra `warp`

            self._rays = RayRenderer(self.config, self._source)
        return self._rays

    def close(self) -> None:
        """Free the GL resources. Closing twice is harmless."""
        self._closed, self._rays = True, None
        self._drop()
        self._stages = []

    def _drop(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None


class Capture:
    """The images of a batch at one moment; those of slots that were not asked for are 0 everywhere.

    Attributes:
        images: uint8 [B, H, W, 3] by camera, rendered when read; so are all mappings here.
        depths: metres from the camera's plane, float32 [B, H, W] by camera.
        segmentations: indices into ``instances``, int16 [B, H, W] by camera.
        images_device, depths_device, segmentations_device: the same as JAX arrays on the device that rendered them;
            reading one raises ``GlError`` where GL renders.
        views: the intrinsics and poses of each camera.
        instances: by slot, the names that segmentation images index.
    """

    def __init__(self, rig: CameraRig, groups: Sequence[Group], problems: Sequence[Problem], slots: np.ndarray) -> None:
        self._rig, self._problems, self._drawn = rig, tuple(problems), slots
        self._models = [group.scene.model for group in groups]
        self._options = list(rig.options)
        self._shown = [group.shown() for group in groups]
        instances: list[tuple[str, ...]] = [()] * len(self._options)
        for group in groups:
            names = ("", ROBOT, *group.scene.entities)
            for slot in group.slots.tolist():
                instances[slot] = names
        self.instances = tuple(instances)
        names = rig.names(self._models)
        self.images, self.images_device = self._of(names, Wanted(), lambda frames: frames.rgb)
        self.depths, self.depths_device = self._of(names, Wanted(rgb=False, depth=True), lambda frames: frames.depth)
        self.segmentations, self.segmentations_device = self._of(
            names, Wanted(rgb=False, segmentation=True), lambda frames: frames.segmentation
        )
        self.views = Rendered(names, self._views)

    def _of(
        self, names: Sequence[str], wanted: Wanted, pick: Callable[[Frames], Mapping[str, np.ndarray]]
    ) -> tuple[Rendered[np.ndarray], Rendered[jax.Array]]:
        """One kind of images: in NumPy, and on the device."""
        if self._rig.config.engine != "raytrace":
            return Rendered(names, self._rendering(wanted, pick)), Rendered(names, _not_on_a_device)
        on_device = Rendered(names, functools.partial(self._traced, wanted))
        return Rendered(names, functools.partial(self._fetched, on_device)), on_device

    def _traced(self, wanted: Wanted, names: Sequence[str]) -> Mapping[str, jax.Array]:
        """Images of all slots on the device; the time until they are there is the first reader's."""
        with self._rig.timed():
            return self._rig.rays().render(
                self._shown, self._problems, self._models, names, wanted, self._options, self._drawn
            )

    def _fetched(self, on_device: Rendered[jax.Array], names: Sequence[str]) -> Mapping[str, np.ndarray]:
        with self._rig.timed():
            on_device.prepare(*names)
            return dict(zip(names, fetch([on_device[name] for name in names]), strict=True))

    def _rendering(
        self, wanted: Wanted, pick: Callable[[Frames], Mapping[str, np.ndarray]]
    ) -> Callable[[Sequence[str]], Mapping[str, np.ndarray]]:
        def render(names: Sequence[str]) -> Mapping[str, np.ndarray]:
            with self._rig.timed():
                renderer = self._rig.renderer(self._rig.stages(self._problems, self._models))
                shots = [self._shots[slot] for slot in self._drawn]
                return self._of_all_slots(pick(renderer.render(shots, self._cameras(names), wanted)))

        return render

    @functools.cached_property
    def _shots(self) -> list[Shot]:
        """What to render of each slot."""
        shots: dict[int, Shot] = {}
        for index, shown in enumerate(self._shown):
            qpos, pos, quat = (np.asarray(array, float) for array in (shown.qpos, shown.body_pos, shown.body_quat))
            for row, slot in enumerate(shown.slots.tolist()):
                shots[slot] = Shot(index, Pose(qpos[row], pos[row], quat[row]), self._options[slot])
        return [shots[slot] for slot in range(len(shots))]

    def _of_all_slots(self, images: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """Images [B, ...] from those of the drawn slots."""
        count = len(self._options)
        if len(self._drawn) == count:
            return images
        every = {name: np.zeros((count, *array.shape[1:]), array.dtype) for name, array in images.items()}
        for name, array in images.items():
            every[name][self._drawn] = array
        return every

    def _views(self, names: Sequence[str]) -> dict[str, CameraView]:
        config = self._rig.config
        stages: Sequence[Viewpoints]
        if config.engine == "raytrace":  # needs no visual model for this
            stages = [Viewpoints(copy.copy(model)) for model in self._models]
        else:
            stages = self._rig.stages(self._problems, self._models)
        return {
            name: camera_view(
                [
                    stages[shot.stage].view(camera, shot.pose, shot.options, slot)
                    for slot, shot in enumerate(self._shots)
                ],
                config.height,
                config.width,
            )
            for name, camera in zip(names, self._cameras(names), strict=True)
        }

    def _cameras(self, names: Sequence[str]) -> list[str | UserCamera]:
        given = {camera.name: camera for camera in self._rig.config.cameras}
        return [given.get(name, name) for name in names]


def _not_on_a_device(names: Sequence[str]) -> NoReturn:
    raise GlError(
        f"images of {', '.join(names)} are drawn by GL, which leaves them in the host's memory: read `images`, or have "
        "rays traced on the device with render=RenderConfig(engine='raytrace')"
    )


def _camera_names(models: Sequence[mujoco.MjModel], given: Sequence[UserCamera]) -> tuple[str, ...]:
    """The cameras that all scenes have, their aliases, and the user cameras."""
    shared = [{model.camera(index).name for index in range(model.ncam)} for model in models]
    scene = [
        name for name in (models[0].camera(i).name for i in range(models[0].ncam)) if all(name in s for s in shared)
    ]
    aliases = [alias for alias, real in ALIASES.items() if real in scene]
    for camera in given:
        if camera.name in (*scene, *aliases):
            raise RenderError(f"the scene already has a camera {camera.name!r}")
    return (*scene, *aliases, *(camera.name for camera in given))


def options_of(given: VisualOptions | Sequence[VisualOptions], num_envs: int) -> list[VisualOptions]:
    """One visual option for each slot, from one for all or from B of them.

    Raises:
        RenderError: the number of options is not the number of slots, or something is none.
    """
    options = [given] * num_envs if isinstance(given, VisualOptions) else inputs.items(given, "options", RenderError)
    if not all(isinstance(option, VisualOptions) for option in options):
        raise RenderError(f"options={inputs.shown(given)}: expected VisualOptions, one for all slots or one a slot")
    if len(options) != num_envs:
        raise RenderError(f"{len(options)} visual options for {num_envs} slots; expected one a slot, or a single one")
    return options
