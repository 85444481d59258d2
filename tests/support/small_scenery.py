"""Small scenes for the ray tracer: one of every shape, light, pane and mirror, through rays and by MuJoCo's own GL."""

from __future__ import annotations

from typing import Any

import jax
import mujoco
import numpy as np

from vecenv.libero.render import gl
from vecenv.libero.render.raytrace import RayTracer, Style
from vecenv.libero.render.scenery import Scenery

SMALL = """
<mujoco>
  <visual><headlight ambient=".1 .1 .1" diffuse=".4 .4 .4" specular=".3 .3 .3"/><map znear="0.01" zfar="50"/></visual>
  <statistic extent="1"/>
  <asset>
    <texture name="squares" type="2d" builtin="checker" rgb1=".9 .9 .5" rgb2=".3 .5 .9" width="64" height="64"/>
    <texture name="palette" type="2d" builtin="flat" rgb1=".5 .4 .3" width="8" height="8"/>
    <mesh name="wedge" vertex="-.1 -.1 0 .1 -.1 0 .1 .1 0 -.1 .1 0 -.1 0 .15 .1 0 .15"/>
    <material name="floor" texture="squares" texrepeat="2 2" texuniform="true" specular="0" reflectance="{floor}"/>
    <material name="plate" rgba=".4 .4 .4 1" specular=".2" shininess=".6" reflectance="{plate}"/>
    <material name="bright" rgba=".9 .2 .2 1" emission=".4" specular=".8" shininess="0"/>
    <material name="plain" rgba=".2 .7 .3 1" specular=".9" shininess=".3"/>
  </asset>
  <worldbody>
    <light pos="1 1 3" dir="-1 -1 -3" diffuse="1.2 1.2 1.2" specular=".3 .3 .3" cutoff="60" attenuation="1 .05 .01"/>
    <light directional="true" dir="1 0 -1" diffuse=".6 .6 .6" ambient=".1 .1 .1" specular="0 0 0"/>
    <geom type="plane" size="2 2 .1" material="floor" group="1"/>
    <geom type="box" size=".4 .3 .05" pos="0 0 .05" euler="0 0 20" material="plate" group="1"/>
    <geom type="sphere" size=".12" pos=".15 .1 .22" material="plain" group="1"/>
    <geom type="capsule" size=".05 .1" pos="-.2 .1 .25" euler="30 0 0" material="bright" group="1"/>
    <geom type="cylinder" size=".08 .06" pos="-.2 -.2 .16" material="plain" group="1"/>
    <geom type="ellipsoid" size=".15 .08 .05" pos=".2 -.2 .2" material="bright" group="1"/>
    <geom type="box" size=".02 .2 .15" pos=".6 -.3 .2" rgba=".2 .2 .9 .4" group="1"/>
    <geom type="mesh" mesh="wedge" pos=".6 .2 0" material="plain" group="1"/>
    <camera name="front" pos="1.4 0 1.0" xyaxes="0 1 0 -.55 0 .83" fovy="50"/>
    <camera name="low" pos=".9 -.8 .35" xyaxes=".66 .75 0 -.2 .18 .96" fovy="50"/>
  </worldbody>
</mujoco>
"""


def look(rays: RayTracer, states: tuple[Any, ...]) -> Any:
    """What the cameras see of the worlds of these states, as NumPy arrays."""
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(rays.look))(*states))


def small(**reflectance: float) -> Scenery:
    model = mujoco.MjModel.from_xml_string(SMALL.format(**{"floor": 0.0, "plate": 0.0, **reflectance}))
    return Scenery(model=model, instances=("", "all"), instance_of_geom=np.ones(model.ngeom, np.int16))


def small_seen(found: Scenery, **options: Any) -> Any:
    """The small scene through its cameras."""
    return small_look(
        RayTracer(found, **{"height": 128, "width": 128, "cameras": ("front", "low"), "antialias": True, **options})
    )


def small_look(rays: RayTracer, style: Style | None = None) -> Any:
    """The small scene, in a style, as its one world has it."""
    data = mujoco.MjData(rays.scenery.model)
    mujoco.mj_kinematics(rays.scenery.model, data)
    states = data.xpos[None].astype(np.float32), data.xquat[None].astype(np.float32), np.zeros((1, 0), np.float32)
    styles = () if style is None else (jax.tree.map(lambda array: array[None], style),)
    return jax.tree.map(lambda images: images[0], look(rays, (*states, *styles)))


def small_drawn(found: Scenery) -> np.ndarray:
    """What MuJoCo draws, without shadows, mirrored as images are delivered."""
    model, data, images = found.model, mujoco.MjData(found.model), []
    mujoco.mj_forward(model, data)
    context = gl.open_context(gl.choose(), 128, 128)
    drawing, frame = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100), mujoco.MjvScene(model, 100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, drawing)
    frame.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = frame.flags[mujoco.mjtRndFlag.mjRND_HAZE] = 0
    for number in range(model.ncam):
        camera = mujoco.MjvCamera()
        camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, number
        options, all_of_it = mujoco.MjvOption(), mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, options, None, camera, all_of_it, frame)
        mujoco.mjr_render(mujoco.MjrRect(0, 0, 128, 128), frame, drawing)
        images.append(np.zeros((128, 128, 3), np.uint8))
        mujoco.mjr_readPixels(images[-1], None, mujoco.MjrRect(0, 0, 128, 128), drawing)
    drawing.free()
    context.free()
    return np.stack(images)[:, ::-1, ::-1]
