"""Images of batches of slots, ray traced on the device that keeps their poses, where the images stay.

In: the scenes of a batch and, for each, the poses that its slots show (``vecenv.libero.physics.base.Shown``). Out: by
camera, images of all slots as JAX arrays. Poses that are on the device already are not fetched from it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.sharding import Mesh

from vecenv.libero.physics.base import Shown
from vecenv.libero.physics.mjx.options import jit
from vecenv.libero.render.culling import View
from vecenv.libero.render.gl import Wanted
from vecenv.libero.render.options import ALIASES, RenderConfig, RenderError, UserCamera, VisualOptions
from vecenv.libero.render.ray_poses import BodyPoses
from vecenv.libero.render.raytrace import RayTracer, Style
from vecenv.libero.render.sources import InstalledVisuals, VisualSource
from vecenv.libero.scene.bddl import Problem, SceneKey
from vecenv.util.devices import Spread

_Key = tuple[SceneKey, tuple[str, ...], Wanted, Mesh | None]


@dataclass(frozen=True)
class _Rows:
    """Which worlds a call renders, the same number on every device.

    Attributes:
        local: index among the worlds of its device of each, int [D * k].
        slots: the slot of each, int [D * k]; one past the last slot where a world only fills up the number.
        whole: whether these are all worlds, in order.
    """

    local: np.ndarray
    slots: np.ndarray
    whole: bool


class RayRenderer:
    """Renders batches without GL: one compiled call of ``RayTracer`` a scene.

    Args:
        config: sizes, level of detail and user cameras.
        source: where sceneries come from; None for the installed packages.
    """

    def __init__(self, config: RenderConfig, source: VisualSource | None = None) -> None:
        self._config, self._source = config, source or InstalledVisuals()
        self._user_cameras = {camera.name: camera for camera in config.cameras}
        self._programs: dict[_Key, tuple[RayTracer, Callable[..., tuple[jax.Array, ...]]]] = {}

    def render(
        self,
        scenes: Sequence[Shown],
        problems: Sequence[Problem],
        models: Sequence[mujoco.MjModel],
        cameras: Sequence[str],
        wanted: Wanted,
        options: Sequence[VisualOptions],
        drawn: np.ndarray,
    ) -> dict[str, jax.Array]:
        """Render some slots through every camera.

        Args:
            scenes: what the slots of each scene show.
            problems, models: the problems of the scenes, and their physics models.
            cameras: names of the scenes' cameras or of the configuration's.
            wanted: one kind of images.
            options: of each slot, B.
            drawn: indices of the slots to render.

        Returns:
            By camera, images [B, H, W, ...] of the kinds of ``Seen``; 0 everywhere where a slot was not rendered.

        Raises:
            RenderError: a scene has no such camera or instance, or a slot's options swap textures or colour materials.
        """
        parts: list[tuple[_Rows, tuple[jax.Array, ...]]] = []
        for problem, model, shown in zip(problems, models, scenes, strict=True):
            rows = _rows(shown, drawn, len(options))
            if rows is None:
                continue
            tracer, draw = self._program(problem, model, tuple(cameras), wanted, shown.mesh)
            styles = self._styles(tracer, cameras, rows, options)
            parts.append((rows, draw(shown.qpos, shown.body_pos, shown.body_quat, rows.local, *styles)))
        return {name: _joined(parts, number, self._blank(wanted, options)) for number, name in enumerate(cameras)}

    def close(self) -> None:
        """Drop what was compiled. Closing twice is harmless."""
        self._programs = {}

    def _blank(self, wanted: Wanted, options: Sequence[VisualOptions]) -> jax.ShapeDtypeStruct:
        """Shape and type of the images of a camera."""
        size = (len(options), self._config.height, self._config.width)
        if wanted.rgb:
            return jax.ShapeDtypeStruct((*size, 3), np.uint8)
        return jax.ShapeDtypeStruct(size, np.float32 if wanted.depth else np.int16)

    def _program(
        self, problem: Problem, model: mujoco.MjModel, cameras: tuple[str, ...], wanted: Wanted, mesh: Mesh | None
    ) -> tuple[RayTracer, Callable[..., tuple[jax.Array, ...]]]:
        """The compiled call of a scene: poses of all its worlds and which of them to render -> images by camera."""
        key = (problem.scene_key(), cameras, wanted, mesh)
        if key not in self._programs:
            scenery = self._source.scenery(problem, level=self._config.lod, colors=self._config.colors)
            scenery.check(model)
            tracer = RayTracer(
                scenery,
                height=self._config.height,
                width=self._config.width,
                cameras=[None if name in self._user_cameras else name for name in cameras],
                rgb=wanted.rgb,
                depth=wanted.depth,
                segmentation=wanted.segmentation,
                antialias=self._config.antialias,
                devices=None if mesh is None else _warp_names(mesh),
            )
            draw = jit(functools.partial(_draw, tracer, BodyPoses(model)))
            self._programs[key] = tracer, draw if mesh is None else Spread(draw, mesh, shared=0)
        return self._programs[key]

    def _styles(
        self, tracer: RayTracer, cameras: Sequence[str], rows: _Rows, options: Sequence[VisualOptions]
    ) -> tuple[Style, ...]:
        """The styles of the rendered worlds, stacked; empty if nothing differs from the plain style."""
        if all(name not in self._user_cameras for name in cameras) and all(each == VisualOptions() for each in options):
            return ()
        own = [self._user_cameras.get(name, name) for name in cameras]
        slots = np.minimum(rows.slots, len(options) - 1).tolist()
        styles = [style_of(tracer, options[slot], own, slot) for slot in slots]
        return (jax.tree.map(lambda *arrays: np.stack(arrays), *styles),)


def _draw(
    tracer: RayTracer,
    poses: BodyPoses,
    qpos: jax.Array,
    body_pos: jax.Array,
    body_quat: jax.Array,
    rows: jax.Array,
    *styles: Style,
) -> tuple[jax.Array, ...]:
    """Images of some worlds, an array [k, H, W, ...] a camera."""
    qpos, body_pos, body_quat = (jnp.asarray(array, jnp.float32)[rows] for array in (qpos, body_pos, body_quat))
    xpos, xquat = jax.vmap(poses)(qpos, body_pos, body_quat)
    seen = jax.vmap(tracer.look)(xpos, xquat, qpos, *styles)
    made = next(array for array in seen if array is not None)
    return tuple(made[:, camera] for camera in range(len(tracer.cameras)))


def _rows(shown: Shown, drawn: np.ndarray, num_envs: int) -> _Rows | None:
    """Which worlds to render for some slots; None if the scene has none of them.

    A compiled call renders one number of worlds: one of few numbers, so that few are compiled.
    """
    chosen = np.flatnonzero(np.isin(shown.slots, drawn))
    if not len(chosen):
        return None
    devices = 1 if shown.mesh is None else shown.mesh.size
    worlds = shown.qpos.shape[0] // devices
    on_device = [chosen[chosen // worlds == device] for device in range(devices)]
    count = _round_up(max(map(len, on_device)), worlds)
    if count == worlds:
        rows = np.arange(devices * worlds)
        # Worlds past the last slot are the batch's own filling.
        slots = np.where(
            np.isin(rows, chosen), np.append(shown.slots, num_envs)[np.minimum(rows, len(shown.slots))], num_envs
        )
        whole = np.array_equal(slots, np.arange(num_envs))
        return _Rows(rows % worlds, slots, whole)
    local, slots = np.zeros((devices, count), int), np.full((devices, count), num_envs)
    for device, own in enumerate(on_device):
        local[device, : len(own)], slots[device, : len(own)] = own - device * worlds, shown.slots[own]
    return _Rows(local.ravel(), slots.ravel(), False)


def _round_up(count: int, most: int) -> int:
    """The next power of two or one and a half times one, at most ``most``."""
    power = 1 << (count - 1).bit_length()
    return min(power * 3 // 4 if power >= 4 and count <= power * 3 // 4 else power, most)


def _joined(
    parts: Sequence[tuple[_Rows, tuple[jax.Array, ...]]], number: int, blank: jax.ShapeDtypeStruct
) -> jax.Array:
    """The images of all slots through one camera, from those of each scene."""
    if len(parts) == 1 and parts[0][0].whole:
        return parts[0][1][number]
    joined = jnp.zeros(blank.shape, blank.dtype)
    for rows, images in parts:
        joined = _put_rows(joined, jax.device_put(images[number], joined.sharding), rows.slots)
    return joined


@functools.partial(jax.jit, donate_argnums=0)
def _put_rows(joined: jax.Array, images: jax.Array, slots: jax.Array) -> jax.Array:
    return joined.at[slots].set(images, mode="drop")


def _warp_names(mesh: Mesh) -> list[str]:
    """Warp's names of a mesh's devices."""
    return [
        f"cuda:{device.local_hardware_id}" if device.platform in ("gpu", "cuda") else "cpu"
        for device in mesh.devices.flat
    ]


def style_of(tracer: RayTracer, options: VisualOptions, cameras: Sequence[str | UserCamera], slot: int) -> Style:
    """The style of a slot's visual options and cameras; ``cameras`` are those of the tracer.

    Raises:
        RenderError: the options swap textures, or name something to colour that is no instance of the scene.
    """
    if options.textures:
        raise RenderError("engine='raytrace' cannot swap textures; use engine='gl'")
    style = tracer.plain_style
    style.light[:] = options.light * np.asarray(options.light_color)
    style.lamps[:] = options.light_shift
    for name, color in options.colors.items():
        if name not in tracer.scenery.instances[1:]:
            there = ", ".join(tracer.scenery.instances[1:])
            raise RenderError(f"engine='raytrace' colours instances only, and {name!r} is none; instances: {there}")
        style.colors[tracer.scenery.instances.index(name)] = color
    for number, camera in enumerate(cameras):
        view = View(np.asarray(style.pos[number]), np.asarray(style.turn[number]), float(style.fovy[number]))
        name = camera.name if isinstance(camera, UserCamera) else camera
        view = View(*camera.in_slot(slot)) if isinstance(camera, UserCamera) else view
        shift = next((options.cameras[key] for key in _names(name) if key in options.cameras), None)
        view = view if shift is None else view.shifted(shift)
        style.pos[number], style.turn[number], style.fovy[number] = view.pos, view.mat, view.fovy
    return style


def _names(camera: str) -> tuple[str, ...]:
    """A camera's name and its aliases."""
    real = ALIASES.get(camera, camera)
    return real, *(alias for alias, other in ALIASES.items() if other == real)
