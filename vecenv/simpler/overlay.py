"""SIMPLER's pictures: the scene drawn by SAPIEN, and the real photograph that replaces its background.

In: an ``Episode`` and a row of facts. Out: ``Picture``: colours as policies see them, depth, and what each pixel shows.
A ``Painter`` keeps *twins*: scenes with everything that is drawn, which are never stepped but posed like the slot they
are to show. So physics itself needs no renderer, and slots that look alike share one twin. Drawing needs a Vulkan
driver: a GPU's, or Mesa's lavapipe on a CPU (Mesa 24.3 or later).

"Visual matching" is upstream's: robot, objects and cabinet are kept where the segmentation shows them, every other
pixel comes from a photograph of the real place taken by the same camera.
"""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import sapien
from PIL import Image

from vecenv.simpler.episodes import Episode
from vecenv.simpler.scenes import CABINET, ROBOT, Scene, SceneSpec, instances
from vecenv.simpler.tasks import Camera, Lighting, SimplerTask

# What upstream gives robots and, in one task, objects.
_SHINY = {"specular": 0.9, "roughness": 0.3}
_MATTE = {"specular": 0.0, "roughness": 1.0, "metallic": 0.0}
_SHADOW_EXTENT, _SHADOW_PIXELS = 5.0, 2048
_FLOOR_HALF = [10.0, 10.0, 0.017]
# Twins kept; each holds a scene's meshes and textures.
_TWINS = 12


class RendererMissing(RuntimeError):
    """There is no usable Vulkan driver; the message says what to install."""


@dataclass(frozen=True)
class Picture:
    """What a camera sees.

    Attributes:
        rgb: colours, uint8 [H, W, 3].
        depth: distance from the camera's plane, metres, float32 [H, W]; of the drawn scene, the photograph has none.
            None where it was not asked for.
        segmentation: index into ``instances``, int16 [H, W]; 0 is everything that the photograph replaces.
        instances: names; the first is "".
    """

    rgb: np.ndarray
    depth: np.ndarray | None
    segmentation: np.ndarray
    instances: tuple[str, ...]


class _Minimal:
    """SAPIEN's shader without shadows: 0.4 of the other's time on a CPU, and as near to SAPIEN 2's pictures."""

    # Textures' formats; positions are whole millimetres.
    _FORMATS = MappingProxyType(
        {
            "Color": "r8g8b8a8unorm",
            "ColorRaw": "r8g8b8a8unorm",
            "PositionSegmentation": "r16g16b16a16sint",
        }
    )

    def choose(self) -> None:
        """Make it the shader of cameras made from now on."""
        sapien.render.set_camera_shader_dir("minimal")
        for name, kind in self._FORMATS.items():
            sapien.render.set_picture_format(name, kind)

    def read(self, camera: Any, depth: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Colours uint8 [H, W, 3], entities [H, W], and depth in metres or None."""
        both = camera.get_picture("PositionSegmentation")
        distance = both[..., 2].astype(np.float32) / -1000 if depth else None
        return camera.get_picture("Color")[..., :3], both[..., 3], distance


class _Default:
    """SAPIEN's standard shader, which can draw shadows."""

    def choose(self) -> None:
        """Make it the shader of cameras made from now on."""
        sapien.render.set_camera_shader_dir("default")
        sapien.render.set_picture_format("Color", "r32g32b32a32sfloat")

    def read(self, camera: Any, depth: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Colours uint8 [H, W, 3], entities [H, W], and depth in metres or None."""
        colour = (np.clip(camera.get_picture("Color")[..., :3], 0.0, 1.0) * 255).astype(np.uint8)
        distance = -camera.get_picture("Position")[..., 2] if depth else None
        return colour, camera.get_picture("Segmentation")[..., 1], distance


MINIMAL, DEFAULT = _Minimal(), _Default()


class Painter:
    """Draws episodes.

    Args:
        root: of the asset tree.
        overlay: ``"background"``, upstream's visual matching; ``"none"``, the drawn scene; or ``"blend"``, both at one
            half, to see how well they match.
        shadows: lights that can cast shadows do; upstream leaves them off.
    """

    def __init__(self, root: Path, overlay: str = "background", shadows: bool = False) -> None:
        self._root, self._overlay, self._shadows = root, overlay, shadows
        self._twins: OrderedDict[Any, _Twin] = OrderedDict()

    def paint(self, episode: Episode, facts: np.void, depth: bool = False) -> Picture:
        """The third-person camera's picture of an episode in the state that the facts describe.

        Args:
            episode: what is to be seen.
            facts: how it stands.
            depth: whether to fetch the depth too.

        Raises:
            RendererMissing: no Vulkan driver.
        """
        drawn = self._twin(episode).draw(facts, episode, depth)
        if self._overlay == "none":
            return drawn
        photo = _photo(self._root / episode.layout.overlay, drawn.rgb.shape[1], drawn.rgb.shape[0])
        if self._overlay == "blend":
            return replace(drawn, rgb=(drawn.rgb // 2 + photo // 2))
        return replace(drawn, rgb=np.where(drawn.segmentation[..., None] > 0, drawn.rgb, photo))

    def _twin(self, episode: Episode) -> _Twin:
        urdf = self._root / episode.task.robot.urdf_path(episode.layout.urdf_version)
        spec = replace(episode.spec, robot=replace(episode.spec.robot, urdf=urdf))
        key = (spec, episode.task.camera, episode.task.lighting, episode.task.matte)
        if key not in self._twins:
            self._twins[key] = _Twin(spec, episode.task, self._shadows)
            while len(self._twins) > _TWINS:
                self._twins.popitem(last=False)
        self._twins.move_to_end(key)
        return self._twins[key]

    def close(self) -> None:
        """Forget all twins."""
        self._twins.clear()


class _Twin:
    """A scene to be drawn."""

    def __init__(self, spec: SceneSpec, task: SimplerTask, shadows: bool) -> None:
        check_renderer()
        self._scene = Scene(spec, visuals=True)
        self._names = instances(spec)
        _light(self._scene.sapien, task.lighting, shadows)
        if spec.stage is None:
            self._draw_floor()
        self._shader = DEFAULT if shadows else MINIMAL
        self._camera = self._mount(task.camera)
        self._paint_surfaces(task)

    def _draw_floor(self) -> None:
        builder = self._scene.sapien.create_actor_builder()
        builder.add_box_visual(half_size=_FLOOR_HALF, material=[1.0, 1.0, 1.0])  # type: ignore
        builder.build_static(name="floor")

    def _mount(self, camera: Camera) -> Any:
        self._shader.choose()
        made = sapien.render.RenderCameraComponent(camera.width, camera.height)
        made.set_perspective_parameters(camera.near, camera.far, *camera.focal, *camera.centre, 0.0)
        frame = self._scene.robot.frames[camera.link]
        frame.body.entity.add_component(made)
        made.set_local_pose(frame.local * sapien.Pose(list(camera.position), list(camera.quat)))
        return made

    def _paint_surfaces(self, task: SimplerTask) -> None:
        if task.shiny:
            for link in self._scene.robot.physx.links:
                _give(link.entity, _SHINY)
        for thing in self._scene.objects:
            if task.matte:
                _give(thing, _MATTE)
            _let_shine(thing)

    def draw(self, facts: np.void, episode: Episode, depth: bool) -> Picture:
        scene = self._scene
        scene.show(facts)
        scene.sapien.update_render()
        self._camera.take_picture()
        colour, shown, distance = self._shader.read(self._camera, depth)
        return Picture(rgb=colour, depth=distance, segmentation=self._numbers(episode)[shown], instances=self._names)

    def _numbers(self, episode: Episode) -> np.ndarray:
        """SAPIEN's number of an entity -> index into the names."""
        scene = self._scene
        kept = [(link.entity, ROBOT) for link in scene.robot.physx.links]
        hidden = episode.task.always_overlaid
        kept += [(thing, thing.name) for thing in scene.objects if thing.name not in hidden]
        if scene.cabinet is not None:
            kept += [(link.entity, CABINET) for link in scene.cabinet.physx.links]
        numbers = np.zeros(1 + max(each.per_scene_id for each in scene.sapien.entities), np.int16)
        for entity, name in kept:
            numbers[entity.per_scene_id] = self._names.index(name)
        return numbers


def _light(scene: sapien.Scene, lighting: Lighting, shadows: bool) -> None:
    scene.set_ambient_light(list(lighting.ambient))
    for light in lighting.directional:
        scene.add_directional_light(
            list(light.direction),
            list(light.colour),
            shadow=light.shadow and shadows,
            shadow_scale=_SHADOW_EXTENT,
            shadow_map_size=_SHADOW_PIXELS,
        )


def _materials(entity: sapien.Entity) -> Iterator[Any]:
    body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
    for shape in body.render_shapes if body is not None else ():  # type: ignore
        for part in shape.parts if hasattr(shape, "parts") else (shape,):
            yield part.material


def _give(entity: sapien.Entity, values: dict[str, float]) -> None:
    """Set properties of all materials of an entity."""
    for material in _materials(entity):
        for name, value in values.items():
            setattr(material, name, value)


def _let_shine(entity: sapien.Entity) -> None:
    """Baked textures are emissive ones without a factor, which SAPIEN 3 takes for 0 and SAPIEN 2 took for 1."""
    for material in _materials(entity):
        if material.emission_texture is not None and not any(material.emission[:3]):
            material.emission = [1.0, 1.0, 1.0, 1.0]


@functools.lru_cache(maxsize=32)
def _photo(path: Path, width: int, height: int) -> np.ndarray:
    """A photograph, uint8 [H, W, 3]."""
    with Image.open(path) as image:
        photo = image.convert("RGB")
        if photo.size != (width, height):
            photo = photo.resize((width, height), Image.Resampling.BILINEAR)
        return np.asarray(photo)


@functools.cache
def check_renderer() -> None:
    """Whether SAPIEN finds something to draw with.

    Raises:
        RendererMissing: it does not.
    """
    try:
        sapien.render.RenderMaterial()
    except RuntimeError as error:
        raise RendererMissing(
            f"SAPIEN cannot draw: {error}. It needs a Vulkan driver: that of an NVIDIA GPU, or on a CPU Mesa's "
            "lavapipe of Mesa 24.3 or later (Debian: mesa-vulkan-drivers from bookworm-backports, with libvulkan1); "
            "see `vecenv doctor`"
        ) from error
