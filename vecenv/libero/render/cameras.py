"""Between an environment and its renderer: what the cameras of a batch saw at one moment, rendered when it is read.

In: the physics groups of a batch and the problem each of them runs. Out: the image mappings of ``Egocentric``. A moment
copies the poses it needs, so its pictures stay those of the moment however the batch moves on; nothing is compiled,
uploaded or drawn before a picture is read. Without a picture read, no GL library is ever loaded.
"""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import mujoco

from vecenv.contract import CameraView, Rendered
from vecenv.libero.physics.base import Group
from vecenv.libero.render.colors import visual_scene
from vecenv.libero.render.drawing import ROBOT, Pose, Stage, camera_view
from vecenv.libero.render.gl import Frames, GlError, GlRenderer, Shot, Wanted
from vecenv.libero.render.options import ALIASES, RenderConfig, RenderError, UserCamera, VisualOptions
from vecenv.libero.scene.bddl import Problem

if TYPE_CHECKING:
    from vecenv.libero.render.raytrace import RayRenderer

# Stages that stay compiled after the last environment that used them is closed; one takes 0.9 GB.
_KEPT = 1
_stages: weakref.WeakValueDictionary[tuple, Stage] = weakref.WeakValueDictionary()
_kept: OrderedDict[tuple, Stage] = OrderedDict()
_compiling = threading.Lock()


def stage_of(problem: Problem, physics: mujoco.MjModel, level: str, colors: str) -> Stage:
    """The stage of a problem's scene, compiled (seconds) unless it is in use or was lately; errors of compile_scene."""
    key = (problem.scene_key(), level, colors)
    with _compiling:
        stage = _stages.get(key)
        if stage is None:
            scene = visual_scene(problem, colors, level)
            mujoco.mj_clearCache(mujoco.mj_getCache())  # 0.37 GB of decoded files
            stage = _stages[key] = Stage(scene)
        _kept[key] = stage
        _kept.move_to_end(key)
        while len(_kept) > _KEPT:
            _kept.popitem(last=False)
    stage.check_physics(physics)
    return stage


class Eyes:
    """The cameras of a batch.

    Args:
        config: how to render.
        num_envs: slots, B.
    """

    def __init__(self, config: RenderConfig, num_envs: int) -> None:
        self.config = config
        self.options: list[VisualOptions] = [VisualOptions()] * num_envs
        self._renderer: GlRenderer | None = None
        self._rays: RayRenderer | None = None
        self._stages: list[Stage] = []
        self._closed = False

    def look(self, groups: Sequence[Group], problems: Sequence[Problem]) -> Moment:
        """What there is to see now; ``problems`` has one of each group."""
        return Moment(self, groups, problems)

    def stages(self, problems: Sequence[Problem], models: Sequence[mujoco.MjModel]) -> list[Stage]:
        """The stages of these problems, whose physics models these are; they are kept until others are asked for.

        Raises:
            GlError: the environment is closed.
        """
        if self._closed:
            raise GlError("the environment is closed: pictures must be read before")
        pairs = zip(problems, models, strict=True)
        self._stages = [stage_of(problem, model, self.config.lod, self.config.colors) for problem, model in pairs]
        return self._stages

    def renderer(self, stages: Sequence[Stage]) -> GlRenderer:
        """A renderer of these stages, kept until others are asked for.

        Raises:
            GlError: there is no GL.
        """
        if self._renderer is None or self._renderer.stages != tuple(stages):
            self._drop()
            self._renderer = GlRenderer(
                stages,
                height=self.config.height,
                width=self.config.width,
                num_threads=self.config.num_threads,
                gl=self.config.gl,
            )
        return self._renderer

    def rays(self) -> RayRenderer:
        """The ray tracer.

        Raises:
            GlError: the environment is closed.
        """
        if self._closed:
            raise GlError("the environment is closed: pictures must be read before")
        if self._rays is None:
            from vecenv.libero.render.raytrace import RayRenderer  # imports JAX

            self._rays = RayRenderer(self.config)
        return self._rays

    def close(self) -> None:
        """Free what GL holds. Closing twice is harmless."""
        self._closed, self._rays = True, None
        self._drop()
        self._stages = []

    def _drop(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None


class Moment:
    """What the cameras of a batch see at one moment.

    Attributes:
        images, depths, segmentations, views: by camera, made when they are read.
        instances: what can be seen in each slot.
    """

    def __init__(self, eyes: Eyes, groups: Sequence[Group], problems: Sequence[Problem]) -> None:
        self._eyes, self._problems = eyes, tuple(problems)
        self._models = [group.scene.model for group in groups]
        count = sum(len(group.slots) for group in groups)
        self._shots: list[Any] = [None] * count
        instances: list[tuple[str, ...]] = [()] * count
        for index, group in enumerate(groups):
            pos, quat = group.expand("body_pos"), group.expand("body_quat")
            qpos = group.seen_qpos.copy()
            for row, slot in enumerate(group.slots.tolist()):
                self._shots[slot] = Shot(index, Pose(qpos[row], pos[row], quat[row]), eyes.options[slot])
                instances[slot] = ("", ROBOT, *group.scene.entities)
        self.instances = tuple(instances)
        names = _camera_names(self._models, eyes.config.cameras)
        self.images = Rendered(names, self._rendering(Wanted(), lambda frames: frames.rgb))
        self.depths = Rendered(names, self._rendering(Wanted(rgb=False, depth=True), lambda frames: frames.depth))
        self.segmentations = Rendered(
            names, self._rendering(Wanted(rgb=False, segmentation=True), lambda frames: frames.segmentation)
        )
        self.views = Rendered(names, self._views)

    def _rendering(self, wanted: Wanted, pick: Callable[[Frames], Any]) -> Callable[[Sequence[str]], Any]:
        def render(names: Sequence[str]) -> Any:
            if self._eyes.config.engine == "raytrace":
                rays = self._eyes.rays()
                return pick(rays.render(self._shots, self._problems, self._models, names, wanted))
            renderer = self._eyes.renderer(self._eyes.stages(self._problems, self._models))
            return pick(renderer.render(self._shots, self._cameras(names), wanted))

        return render

    def _views(self, names: Sequence[str]) -> dict[str, CameraView]:
        stages, config = self._eyes.stages(self._problems, self._models), self._eyes.config
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
        own = {camera.name: camera for camera in self._eyes.config.cameras}
        return [own.get(name, name) for name in names]


def _camera_names(models: Sequence[mujoco.MjModel], own: Sequence[UserCamera]) -> tuple[str, ...]:
    """The user cameras, the cameras that all scenes have, and their other names."""
    shared = [{model.camera(index).name for index in range(model.ncam)} for model in models]
    scene = [
        name for name in (models[0].camera(i).name for i in range(models[0].ncam)) if all(name in s for s in shared)
    ]
    aliases = [alias for alias, real in ALIASES.items() if real in scene]
    for camera in own:
        if camera.name in (*scene, *aliases):
            raise RenderError(f"the scene has a camera {camera.name!r} already")
    return (*scene, *aliases, *(camera.name for camera in own))


def options_of(given: VisualOptions | Sequence[VisualOptions], num_envs: int) -> list[VisualOptions]:
    """One option a slot, of one for all or of B.

    Raises:
        RenderError: not as many as slots.
    """
    options = [given] * num_envs if isinstance(given, VisualOptions) else list(given)
    if len(options) != num_envs:
        raise RenderError(f"{len(options)} visual options for {num_envs} slots")
    return options
