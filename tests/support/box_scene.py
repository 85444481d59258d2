"""A scene of a few boxes that compiles in a millisecond, and shots of it."""

from __future__ import annotations

from types import MappingProxyType

import mujoco
import numpy as np

from vecenv.libero.render.drawing import Pose, Stage
from vecenv.libero.render.gl import GlRenderer, Shot
from vecenv.libero.render.options import UserCamera, VisualOptions
from vecenv.libero.scene.arenas import ARENAS
from vecenv.libero.scene.scene import Entity, Scene

XML = """
<mujoco>
  <asset>
    <texture name="checks" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1" width="64" height="64"/>
    <texture name="plain" type="2d" builtin="flat" rgb1="0 1 0" width="64" height="64"/>
    <material name="cloth" texture="plain"/>
    <mesh name="cube" vertex="-1 -1 -1 1 -1 -1 -1 1 -1 1 1 -1 -1 -1 1 1 -1 1 -1 1 1 1 1 1" scale="0.1 0.1 0.1"/>
  </asset>
  <worldbody>
    <light pos="0 0 3" castshadow="false"/>
    <camera name="agentview" pos="0 0 2"/>
    <camera name="side" pos="0 -2 0.1" xyaxes="1 0 0 0 0 1"/>
    <geom name="floor" type="plane" size="2 2 0.1" rgba="0.5 0.5 0.5 1" group="1"/>
    <body name="box_1_main" pos="0.3 0.1 0.1">
      <freejoint/>
      <geom name="box_1_g0" type="mesh" mesh="cube" rgba="0.8 0.8 0.8 1" group="1"/>
      <geom name="box_1_g1" type="box" size="0.3 0.3 0.3" group="0"/>
    </body>
    <body name="ball_1_main" pos="-0.3 -0.2 0.1">
      <freejoint/>
      <geom name="ball_1_g0" type="sphere" size="0.1" material="cloth" group="1"/>
    </body>
    <body name="robot0_base"><geom type="sphere" size="0.05" pos="0 0.5 0" rgba="1 1 1 1" group="1"/></body>
  </worldbody>
</mujoco>
"""
SIZE = 48


def tiny_scene() -> Scene:
    def entity(name: str) -> Entity:
        return Entity(
            name=name,
            category=name.removesuffix("_1"),
            fixture=False,
            root_body=f"{name}_main",
            joints=(),
            contact_geoms=(),
            bottom_z=0.0,
            top_z=0.0,
            radius=0.0,
        )

    return Scene(
        problem_name="tiny",
        model=mujoco.MjModel.from_xml_string(XML),
        arena=ARENAS["libero_floor_manipulation"],
        entities=MappingProxyType({name: entity(name) for name in ("box_1", "ball_1")}),
        regions=MappingProxyType({}),
    )


def shot(stage: Stage, *, box: tuple[float, float] = (0.3, 0.1), options: VisualOptions | None = None) -> Shot:
    model = stage.model
    qpos = model.qpos0.copy()
    qpos[:2] = box
    return Shot(0, Pose(qpos, model.body_pos.copy(), model.body_quat.copy()), options or VisualOptions())


def rgb(renderer: GlRenderer, *shots: Shot, camera: str | UserCamera = "agentview") -> np.ndarray:
    frames = renderer.render(shots, [camera])
    return frames.rgb[camera if isinstance(camera, str) else camera.name]
