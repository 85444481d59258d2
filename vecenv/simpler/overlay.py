"""SIMPLER's images: the scene rendered by SAPIEN, and the photograph that replaces its background.

In: what to render of an episode, and a row of facts. Out, in arrays of the caller: colours as policies see them, depth,
and a segmentation. A ``Renderer`` keeps scenes with visual shapes that are never stepped; they take the poses of the
slot to render. So physics needs no renderer, and slots that look alike share one of these scenes. Rendering needs a
Vulkan driver: a GPU's, or Mesa's lavapipe on a CPU (Mesa 24.3 or later).

"Visual matching" is upstream's: robot, objects and cabinet are kept where the segmentation shows them, every other
pixel comes from a photograph of the real place taken by the same camera.
"""

from __future__ import annotations

import functools
import mmap
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import sapien
from PIL import Image

from vecenv.errors import SimulationError
from vecenv.simpler.episodes import Episode, drawn_stage, require_drawable
from vecenv.simpler.physics.scenes import Scene
from vecenv.simpler.physics.spec import CABINET, ROBOT, SceneSpec, instances
from vecenv.simpler.task_spec import Camera, Lighting

# Materials that upstream gives to robots and, in one task, to objects.
_SHINY = {"specular": 0.9, "roughness": 0.3}
_MATTE = {"specular": 0.0, "roughness": 1.0, "metallic": 0.0}
_SHADOW_EXTENT, _SHADOW_PIXELS = 5.0, 2048
_FLOOR_HALF = [10.0, 10.0, 0.017]
# Scenes kept; each holds its meshes and textures.
_MAX_SCENES = 12


class RendererMissing(SimulationError):
    """There is no usable Vulkan driver; the message says what to install."""


class Images(NamedTuple):
    """Images of one camera or of one camera a slot.

    Attributes:
        rgb: colours, uint8 [..., H, W, 3].
        segmentation: index into ``physics.spec.instances`` of the episode's scene, int16 [..., H, W]; 0 is
            everything that the photograph replaces.
        depth: distance from the camera's plane, metres, float32 [..., H, W]; of the drawn scene, the photograph has
            none. None where depth was not requested.
    """

    rgb: np.ndarray
    segmentation: np.ndarray
    depth: np.ndarray | None

    def of(self, slot: int) -> Images:
        """The images of one slot, as views."""
        depth = None if self.depth is None else self.depth[slot]
        return Images(self.rgb[slot], self.segmentation[slot], depth)


@dataclass(frozen=True, kw_only=True)
class ImageBuffer:
    """Layout of the memory for images of B slots, with depth if ``deep``."""

    slots: int
    height: int
    width: int
    deep: bool

    @property
    def bytes(self) -> int:
        """Size of the memory, bytes."""
        return self.slots * self.height * self.width * (9 if self.deep else 5)

    def images(self, memory: mmap.mmap | bytearray) -> Images:
        """Arrays with B rows over a buffer."""
        shape, count = (self.slots, self.height, self.width), self.slots * self.height * self.width
        begin = 4 * count if self.deep else 0
        return Images(
            depth=np.frombuffer(memory, np.float32, count).reshape(shape) if self.deep else None,
            segmentation=np.frombuffer(memory, np.int16, count, begin).reshape(shape),
            rgb=np.frombuffer(memory, np.uint8, 3 * count, begin + 2 * count).reshape(*shape, 3),
        )


class _Minimal:
    """SAPIEN's shader without shadows: 0.4 of the other's time on a CPU, and as close to SAPIEN 2's images."""

    # Textures' formats; positions are whole millimetres.
    _FORMATS = MappingProxyType(
        {
            "Color": "r8g8b8a8unorm",
            "ColorRaw": "r8g8b8a8unorm",
            "PositionSegmentation": "r16g16b16a16sint",
        }
    )

    def choose(self) -> None:
        """Use it for cameras that are created from now on."""
        sapien.render.set_camera_shader_dir("minimal")
        for name, kind in self._FORMATS.items():
            sapien.render.set_picture_format(name, kind)

    def read(
        self, camera: sapien.render.RenderCameraComponent, depth: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours uint8 [H, W, 4] and entities int16 [H, W]; fills ``depth`` [H, W] with metres."""
        both = camera.get_picture("PositionSegmentation")
        if depth is not None:
            np.divide(both[..., 2], -1000, out=depth, dtype=np.float32)
        return camera.get_picture("Color"), both[..., 3]


class _Default:
    """SAPIEN's standard shader, which can draw shadows."""

    def choose(self) -> None:
        """Use it for cameras that are created from now on."""
        sapien.render.set_camera_shader_dir("default")
        sapien.render.set_picture_format("Color", "r32g32b32a32sfloat")

    def read(
        self, camera: sapien.render.RenderCameraComponent, depth: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours uint8 [H, W, 3] and entities [H, W]; fills ``depth`` [H, W] with metres."""
        if depth is not None:
            np.negative(camera.get_picture("Position")[..., 2], out=depth)
        colour = (np.clip(camera.get_picture("Color")[..., :3], 0.0, 1.0) * 255).astype(np.uint8)
        return colour, camera.get_picture("Segmentation")[..., 1]


MINIMAL, DEFAULT = _Minimal(), _Default()


@dataclass(frozen=True, kw_only=True)
class RenderStyle:
    """How episodes are rendered.

    Attributes:
        overlay: ``"background"``, upstream's visual matching; ``"none"``, the drawn scene; or ``"blend"``, both at one
            half, to see how well they match.
        shadows: lights that can cast shadows do; else only those that do upstream, the ones around cabinets of variant
            aggregation.
    """

    overlay: str = "background"
    shadows: bool = False


@dataclass(frozen=True, kw_only=True)
class RenderSubject:
    """What to render of an episode.

    Attributes:
        spec: its scene, with the robot's own colours.
        camera, lighting: of the task.
        shiny, matte: what upstream does to the robot's and to objects' materials.
        hidden: objects that the photograph replaces.
        photo: file of the photograph; None where there is none, and the drawn scene is shown.
    """

    spec: SceneSpec
    camera: Camera
    lighting: Lighting
    shiny: bool
    matte: bool
    hidden: frozenset[str]
    photo: Path | None

    @classmethod
    def of(cls, episode: Episode, root: Path) -> RenderSubject:
        """What to render of an episode; ``root``: of the asset tree.

        Raises:
            AssetsMissing: a file that only rendering needs is missing; the message names it.
        """
        task, layout = episode.task, episode.layout
        require_drawable(episode, root)
        urdf = root / task.robot.urdf_path(layout.urdf_version)
        return cls(
            spec=replace(episode.spec, robot=replace(episode.spec.robot, urdf=urdf), stage=drawn_stage(episode, root)),
            camera=task.camera,
            lighting=task.lighting,
            shiny=task.shiny,
            matte=task.matte,
            hidden=frozenset(task.always_overlaid),
            photo=root / layout.overlay if layout.overlay else None,
        )


class Renderer:
    """Renders episodes in one style."""

    def __init__(self, style: RenderStyle) -> None:
        self.style = style
        self._scenes: OrderedDict[Any, _RenderScene] = OrderedDict()

    def render(self, subject: RenderSubject, facts: np.void, out: Images) -> None:
        """Render the third-person camera's image of a subject.

        Args:
            subject: what to render.
            facts: its state.
            out: arrays to fill.

        Raises:
            RendererMissing: no Vulkan driver.
        """
        colours = self._scene_of(subject).draw(facts, subject.hidden, out)
        if self.style.overlay == "none" or subject.photo is None:
            out.rgb[:] = colours[..., :3]
            return
        height, width = out.segmentation.shape
        photo = _photo(subject.photo, width, height)
        if self.style.overlay == "blend":
            np.add(colours[..., :3] // 2, photo // 2, out=out.rgb)
            return
        out.rgb[:] = photo
        shown = np.flatnonzero(out.segmentation)
        out.rgb.reshape(-1, 3)[shown] = colours.reshape(-1, colours.shape[-1])[shown, :3]

    def _scene_of(self, subject: RenderSubject) -> _RenderScene:
        key = (subject.spec, subject.camera, subject.lighting, subject.shiny, subject.matte)
        if key not in self._scenes:
            self._scenes[key] = _RenderScene(subject, self.style.shadows)
            while len(self._scenes) > _MAX_SCENES:
                self._scenes.popitem(last=False)
        self._scenes.move_to_end(key)
        return self._scenes[key]

    def close(self) -> None:
        """Release all scenes."""
        self._scenes.clear()


class _RenderScene:
    """A scene with visual shapes, never stepped."""

    def __init__(self, subject: RenderSubject, shadows: bool) -> None:
        check_renderer()
        shadows = shadows or subject.lighting.casts
        self._scene = Scene(subject.spec, visuals=True)
        self._names = instances(subject.spec)
        _light(self._scene.sapien, subject.lighting, shadows)
        if subject.spec.stage is None:
            self._draw_floor()
        self._shader = DEFAULT if shadows else MINIMAL
        self._camera = self._mount(subject.camera)
        self._set_materials(subject)

    def _draw_floor(self) -> None:
        builder = self._scene.sapien.create_actor_builder()
        builder.add_box_visual(half_size=_FLOOR_HALF, material=[1.0, 1.0, 1.0])  # type: ignore
        builder.build_static(name="floor")

    def _mount(self, camera: Camera) -> sapien.render.RenderCameraComponent:
        self._shader.choose()
        made = sapien.render.RenderCameraComponent(camera.width, camera.height)
        made.set_perspective_parameters(camera.near, camera.far, *camera.focal, *camera.centre, 0.0)
        frame = self._scene.robot.frames[camera.link]
        frame.body.entity.add_component(made)
        made.set_local_pose(frame.local * sapien.Pose(list(camera.position), list(camera.quat)))
        return made

    def _set_materials(self, subject: RenderSubject) -> None:
        if subject.shiny:
            for link in self._scene.robot.physx.links:
                _set_properties(link.entity, _SHINY)
        for thing in self._scene.objects:
            if subject.matte:
                _set_properties(thing, _MATTE)
            _enable_emission(thing)

    def draw(self, facts: np.void, hidden: frozenset[str], out: Images) -> np.ndarray:
        """Fill segmentation and depth; returns the colours, uint8 [H, W, 3 or 4]."""
        scene = self._scene
        scene.show(facts)
        scene.sapien.update_render()
        self._camera.take_picture()
        colour, shown = self._shader.read(self._camera, out.depth)
        np.take(self._numbers(hidden), shown, out=out.segmentation, mode="clip")
        return colour

    def _numbers(self, hidden: frozenset[str]) -> np.ndarray:
        """SAPIEN's number of an entity -> index into the names."""
        scene = self._scene
        kept = [(link.entity, ROBOT) for link in scene.robot.physx.links]
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


def _materials(entity: sapien.Entity) -> Iterator[sapien.render.RenderMaterial]:
    body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
    for shape in body.render_shapes if body is not None else ():  # type: ignore
        for part in shape.parts if hasattr(shape, "parts") else (shape,):
            yield part.material


def _set_properties(entity: sapien.Entity, values: dict[str, float]) -> None:
    """Set properties of all materials of an entity."""
    for material in _materials(entity):
        for name, value in values.items():
            setattr(material, name, value)


def _enable_emission(entity: sapien.Entity) -> None:
    """Set the emission factor of baked textures to 1: SAPIEN 3 reads a missing factor as 0, SAPIEN 2 as 1."""
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
    """Check that SAPIEN can render.

    Raises:
        RendererMissing: it cannot.
    """
    try:
        sapien.render.RenderMaterial()
    except RuntimeError as error:
        raise RendererMissing(
            f"SAPIEN cannot draw: {error}. It needs a Vulkan driver: that of an NVIDIA GPU, or on a CPU Mesa's "
            "lavapipe of Mesa 24.3 or later (Debian: mesa-vulkan-drivers from bookworm-backports, with libvulkan1); "
            "see `vecenv doctor`"
        ) from error
