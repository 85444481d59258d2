"""Images of worlds, ray traced inside ``jax.jit``: MuJoCo Warp's renderer, on NVIDIA GPUs, without GL.

In: a scenery (``vecenv.libero.render.scenery``) and, for each world, the poses of its bodies as MJX keeps them. Out:
images of one or several cameras, as delivered everywhere in vecenv: rows from the top, mirrored. ``RayTracer.look`` is
a function of one world for ``vmap``, ``jit`` and ``scan``; all worlds it is mapped over share one render context, which
is created when such a batch is first traced. On a CPU the same code runs, slowly.
"""

from __future__ import annotations

import copy
import math
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import warp as wp
from jaxtyping import PyTree
from mujoco import mjx

from vecenv.libero.physics.mjx import kernels
from vecenv.libero.physics.mjx.options import remember_compilations
from vecenv.libero.render import ray_passes
from vecenv.libero.render.options import ALIASES, POLICY_CAMERAS, RenderError
from vecenv.libero.render.ray_kernel import make_kernel
from vecenv.libero.render.ray_light import HEADLIGHT
from vecenv.libero.render.ray_surface import mipmapped
from vecenv.libero.render.scenery import Scenery
from vecenv.libero.render.surfaces import drawn_colors
from vecenv.util.mapped import Sized
from vecenv.util.rotations import quat_to_mat

if TYPE_CHECKING:
    from vecenv.libero.physics.private import RenderContext

# Threads of a block on the GPU, registers of a thread, and the tile of pixels, rows and columns, that threads next to
# each other trace: rays that travel together are faster. Measured on an H200, benchmarks/render_gpu.py.
BLOCK, REGISTERS, TILE = 128, 96, (8, 8)


# A leaf of a pytree: NumPy outside of JAX's transformations, JAX inside.
Array = np.ndarray | jax.Array


class Seen(NamedTuple):
    """Images of C cameras of one world; those that were not requested are None.

    Attributes:
        rgb: uint8 [C, H, W, 3].
        depth: metres from the camera's plane, 0 where nothing is, float32 [C, H, W].
        segmentation: index into the scenery's ``instances``, int16 [C, H, W].
    """

    rgb: jax.Array | None
    depth: jax.Array | None
    segmentation: jax.Array | None


class Style(NamedTuple):
    """Camera poses and appearance of one world, with C cameras and a scenery of I instances; see ``plain_style``.

    Attributes:
        light: scale of red, green and blue light, [3].
        lamps: moves all lamps, metres, world frame, [3].
        colors: scale of red, green, blue of each of the scenery's ``instances``, [I, 3].
        pos, turn: translation [C, 3], metres, and rotation [C, 3, 3] of each camera in its own frame (x right, y up,
            looking along -z); for a free camera, its pose in the world.
        fovy: vertical field of view of each camera, degrees, [C].
    """

    light: Array
    lamps: Array
    colors: Array
    pos: Array
    turn: Array
    fovy: Array


class RayTracer:
    """The cameras of a scenery.

    Args:
        scenery: what is drawn.
        height, width: of the images, pixels.
        cameras: which cameras, in the order of the images; ``"wrist"`` is an alias of ``"robot0_eye_in_hand"``, and
            None is a free camera, whose pose a ``Style`` gives.
        rgb, depth, segmentation: which images ``look`` makes.
        samples: rays per pixel along each side, averaged, for every pixel. 2 takes four times as long as 1.
        antialias: whether pixels that differ from their neighbours are traced again, through the four points where GL
            takes its samples; with one sample per pixel only. Depths and segmentations stay those of the middle. Images
            take about twice as long.
        block_dim: threads of a block on the GPU.
        tile: most rows and columns of pixels that neighbouring threads trace; ``(1, 1)`` for row by row.
        registers: most registers of a thread on the GPU; 0 leaves it to the compiler.
        culling: whether faces are visible from their front only, as in GL; without, rendering is 7 % faster.
        devices: Warp's names of the devices that render, such as ``"cuda:1"``; None for the default device.

    Raises:
        RenderError: the scenery has no such camera.
    """

    def __init__(
        self,
        scenery: Scenery,
        *,
        height: int = 256,
        width: int = 256,
        cameras: Sequence[str | None] = POLICY_CAMERAS,
        rgb: bool = True,
        depth: bool = False,
        segmentation: bool = False,
        samples: int = 1,
        antialias: bool = False,
        block_dim: int = BLOCK,
        tile: tuple[int, int] = TILE,
        registers: int = REGISTERS,
        culling: bool = True,
        devices: Sequence[str] | None = None,
    ) -> None:
        self.scenery, self.height, self.width, self.cameras = scenery, height, width, tuple(cameras)
        self._wanted = rgb, depth, segmentation
        self._model = model = scenery.model
        self._camera_ids = [0 if name is None else _camera(model, name) for name in cameras]
        self._is_free = np.array([name is None for name in cameras])
        remember_compilations()
        kernels.install()
        self._put = mjx.put_model(model, impl="warp")
        sizes = self._put._impl.block_dim.__class__(render=block_dim)
        self._put = self._put.tree_replace({"_impl.block_dim": sizes}).replace(**_lamps(model))
        self._put = self._put.replace(cam_sensorsize=self._pixel_sizes())
        self._tile = math.gcd(height, tile[0]), math.gcd(width, tile[1])
        self._blank = mjx.make_data(model, impl="warp", naconmax=1, njmax=1)
        self._antialias = antialias and samples == 1 and rgb
        per_side = ray_passes.PASSES_PER_SIDE if self._antialias else samples
        self._options = {"samples_per_pixel": per_side, "enable_backface_culling": culling}
        self._registers, self._devices = registers, devices
        self._contexts: dict[int, Any] = {}
        self._making = threading.Lock()
        self._look = Sized(self._look_at, self._context)

    @property
    def plain_style(self) -> Style:
        """The style that changes nothing; a free camera is at the world's origin, looks down, and has a fovy of 45."""
        count = len(self.cameras)
        fovy = np.where(self._is_free, 45.0, self._model.cam_fovy[self._camera_ids])
        return Style(
            light=np.ones(3, np.float32),
            lamps=np.zeros(3, np.float32),
            colors=np.ones((len(self.scenery.instances), 3), np.float32),
            pos=np.zeros((count, 3), np.float32),
            turn=np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
            fovy=fovy.astype(np.float32),
        )

    def look(self, xpos: jax.Array, xquat: jax.Array, qpos: jax.Array, style: Style | None = None) -> Seen:
        """Render what the cameras of one world see.

        Args:
            xpos: positions of the bodies of the physics model, world frame, metres, [nbody, 3].
            xquat: their orientations, wxyz, [nbody, 4].
            qpos: [nq], read for burners, which are visible while a knob is turned.
            style: None for ``plain_style``.
        """
        return self._look(xpos, xquat, qpos) if style is None else self._look(xpos, xquat, qpos, style)

    def _context(self, num_worlds: int) -> Any:
        with self._making:  # with several devices, a thread for each traces at the same time
            if num_worlds not in self._contexts:
                rgb, depth, segmentation = self._wanted
                with jax.ensure_compile_time_eval():
                    context = mjx.create_render_context(
                        self._model,
                        nworld=num_worlds,
                        devices=self._devices,
                        cam_res=(self.width, self.height),
                        cam_active=self._camera_ids,
                        render_rgb=rgb,
                        render_depth=depth,
                        render_seg=segmentation,
                        enabled_geom_groups=[1],
                        **self._options,
                    )
                    for name in self._devices or (None,):
                        with wp.ScopedDevice(name) as device:
                            self._prepare(context._contexts[device.ordinal], num_worlds)
                            # Made on Warp's stream, read on JAX's, which does not wait for it.
                            wp.synchronize_device(device)
                    self._contexts[num_worlds] = context
            return self._contexts[num_worlds].pytree()

    def _prepare(self, context: RenderContext, num_worlds: int) -> None:
        """Give a render context our kernel, and what it needs."""
        if self._antialias:
            context.ray = ray_passes.aimed_rays(self._model, self._camera_ids, self.height, self.width)
            context.flex_group_root = ray_passes.empty_queue(num_worlds, context.total_rays)
        self._tile_rays(context)
        context.textures_registry = mipmapped(self._model)
        context.textures = wp.array(context.textures_registry, dtype=wp.Texture2D)
        context._megakernel = make_kernel(
            self._model, context, tile=self._tile, antialias=self._antialias, registers=self._registers
        )

    def _tile_rays(self, context: RenderContext) -> None:
        """Reorder a render context's rays from rows of pixels to tiles, for each camera and sample."""
        (rows, columns), rays = self._tile, context.ray.numpy()
        tiled = rays.reshape(-1, self.height // rows, rows, self.width // columns, columns, 3).swapaxes(2, 3)
        context.ray.assign(np.ascontiguousarray(tiled).reshape(rays.shape))

    def _image(self, buffer: jax.Array) -> jax.Array:
        """Images [C, H, W, ...] as delivered, of a buffer [C * H * W, ...] in the order of tiles."""
        (rows, columns), rest = self._tile, buffer.shape[1:]
        tiles = buffer.reshape(-1, self.height // rows, self.width // columns, rows, columns, *rest)
        return tiles.swapaxes(2, 3).reshape(-1, self.height, self.width, *rest)[:, :, ::-1]

    def _look_at(
        self, context: PyTree, xpos: jax.Array, xquat: jax.Array, qpos: jax.Array, style: Style | None = None
    ) -> Seen:
        style = self.plain_style if style is None else style
        model = self._put.replace(geom_rgba=self._colors(qpos, style), cam_fovy=self._widths(style))
        model = model.replace(
            light_ambient=self._put.light_ambient * style.light,
            light_diffuse=self._put.light_diffuse * style.light,
            light_specular=self._put.light_specular * style.light,
        )
        data = mjx.refit_bvh(model, self._posed(xpos, xquat, style), context)
        if self._wanted[2]:
            rgb, depth, segmentation, _ = mjx.render_with_segmentation(model, data, context)
            return self._delivered(rgb, depth, segmentation)
        rgb, depth, _ = mjx.render(model, data, context)
        return self._delivered(rgb, depth, None)

    def _posed(self, xpos: jax.Array, xquat: jax.Array, style: Style) -> mjx.Data:
        model, chosen = self._model, self._camera_ids
        mats = jax.vmap(quat_to_mat)(xquat.astype(jnp.float32))
        xpos = xpos.astype(jnp.float32)

        def place(body: np.ndarray, pos: np.ndarray, own: np.ndarray) -> tuple[jax.Array, jax.Array]:
            turn = mats[body]
            return xpos[body] + _times(turn, jnp.asarray(pos, jnp.float32)[..., None])[..., 0], _times(
                turn, jnp.asarray(own, jnp.float32)
            )

        free = self._is_free[:, None]
        bodies = np.where(self._is_free, 0, model.cam_bodyid[chosen])
        own_pos = np.where(free, 0.0, model.cam_pos[chosen])
        own_mat = np.where(free[..., None], np.eye(3), _matrices(model.cam_quat[chosen]))
        geom_xpos, geom_xmat = place(model.geom_bodyid, model.geom_pos, _matrices(model.geom_quat))
        cam_xpos, cam_xmat = place(bodies, own_pos, own_mat)
        light_xpos, light_xdir = place(model.light_bodyid, model.light_pos, model.light_dir[..., None])
        spare = jnp.zeros((self._put.light_type.shape[0] - model.nlight, 3))
        return self._blank.tree_replace(
            {
                "geom_xpos": geom_xpos,
                "geom_xmat": geom_xmat,
                "cam_xpos": cam_xpos + _times(cam_xmat, jnp.asarray(style.pos)[..., None])[..., 0],
                "cam_xmat": _times(cam_xmat, jnp.asarray(style.turn)),
                "_impl.light_xpos": jnp.concatenate([light_xpos + style.lamps, spare]),
                "_impl.light_xdir": jnp.concatenate([light_xdir[..., 0], spare]),
            }
        )

    def _pixel_sizes(self) -> np.ndarray:
        """Width and height of a pixel 1 m away from each camera, metres, [C, 2]."""
        half = np.tan(np.deg2rad(self._model.cam_fovy[self._camera_ids]) / 2)
        return np.repeat(2 * half[:, None] / self.height, 2, axis=1).astype(np.float32)

    def _widths(self, style: Style) -> jax.Array:
        """How much wider the cameras see than those that the contexts' rays were made for."""
        half = np.tan(np.deg2rad(self._model.cam_fovy[self._camera_ids]) / 2)
        return jnp.tan(jnp.deg2rad(jnp.asarray(style.fovy)) / 2) / jnp.asarray(half, jnp.float32)

    def _colors(self, qpos: jax.Array, style: Style) -> jax.Array:
        """Colours of the geoms; a burner that is off has alpha 0, which makes it invisible."""
        rgba = jnp.asarray(drawn_colors(self._model))
        rgba = rgba.at[:, :3].multiply(jnp.asarray(style.colors)[self.scenery.instance_of_geom])
        for burner in self.scenery.burners:
            turned = burner.sign * qpos[np.array(burner.knobs)]
            is_on = (turned >= burner.bound if burner.inclusive else turned > burner.bound).any()
            rgba = rgba.at[burner.geom, 3].set(jnp.where(is_on, rgba[burner.geom, 3], 0.0))
        return rgba

    def _delivered(self, rgb: jax.Array, depth: jax.Array, segmentation: jax.Array | None) -> Seen:
        """The images of all cameras from the renderer's flat buffers."""
        wants_rgb, wants_depth, _ = self._wanted
        return Seen(
            rgb=_unpacked(self._image(rgb.reshape(-1))) if wants_rgb else None,
            depth=self._image(depth.reshape(-1)) if wants_depth else None,
            segmentation=None if segmentation is None else self._instances(self._image(segmentation.reshape(-1, 2))),
        )

    def _instances(self, codes: jax.Array) -> jax.Array:
        """Instances from the geom and object type [..., 2] of each pixel."""
        table = jnp.asarray(np.append(self.scenery.instance_of_geom, np.int16(0)))
        return table[codes[..., 0]]  # -1, the table's last entry, is the background


def _lamps(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """MJX's fields of the lights, with the headlight as one more light if it is on."""
    head, colors = model.vis.headlight, ("ambient", "diffuse", "specular")
    more = {
        "type": HEADLIGHT,
        "castshadow": False,
        "active": True,
        "attenuation": (1, 0, 0),
        "cutoff": 45,
        "exponent": 0,
    }
    more |= {name: getattr(head, name) for name in colors}
    found = {}
    for name, value in more.items():
        own = getattr(model, f"light_{name}")
        dtype = {np.dtype(np.float64): np.float32, np.dtype(np.uint8): bool}.get(own.dtype, own.dtype)
        extra = np.array([value] if head.active else [], own.dtype).reshape(-1, *own.shape[1:])
        found[f"light_{name}"] = np.concatenate([own, extra]).astype(dtype)
    return found


def poses(
    model: mujoco.MjModel, qpos: np.ndarray, body_pos: np.ndarray, body_quat: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the bodies of B worlds for ``RayTracer.look``, computed without MJX.

    Args:
        model: the physics model.
        qpos: [B, nq].
        body_pos, body_quat: poses of the bodies in their parents, [B, nbody, 3] and [B, nbody, 4].

    Returns:
        Positions [B, nbody, 3] and orientations wxyz [B, nbody, 4], world frame, float32.
    """
    own, data = copy.copy(model), mujoco.MjData(model)
    xpos, xquat = np.zeros(body_pos.shape, np.float32), np.zeros(body_quat.shape, np.float32)
    for world in range(len(qpos)):
        own.body_pos[:], own.body_quat[:], data.qpos[:] = body_pos[world], body_quat[world], qpos[world]
        mujoco.mj_kinematics(own, data)
        xpos[world], xquat[world] = data.xpos, data.xquat
    return xpos, xquat


def _camera(model: mujoco.MjModel, name: str) -> int:
    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, ALIASES.get(name, name))
    if found < 0:
        there = ", ".join(model.camera(index).name for index in range(model.ncam))
        raise RenderError(f"no camera {name!r}; this scene has {there}")
    return found


def _matrices(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices [n, 3, 3] of quaternions wxyz [n, 4]."""
    out = np.zeros((len(quats), 9))
    for row, quat in zip(out, quats, strict=True):
        mujoco.mju_quat2Mat(row, quat)
    return out.reshape(-1, 3, 3)


def _times(a: jax.Array, b: jax.Array) -> jax.Array:
    """Matrix products in full precision: GPUs round the factors of ``@`` to ten bits."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def _unpacked(packed: jax.Array) -> jax.Array:
    """uint8 [..., 3] of 0xAARRGGBB."""
    return jnp.stack([(packed >> shift).astype(jnp.uint8) for shift in (16, 8, 0)], axis=-1)
