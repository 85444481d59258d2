"""Rendering options as data: cameras, visual options of a slot, and how to render.

Nothing here draws. ``RenderConfig`` goes into ``vecenv.make``; ``UserCamera`` adds a viewpoint; ``VisualOptions``
changes light, viewpoint, colours and textures of one slot, and ``VisualVariation.draw`` makes one from a seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from vecenv.errors import InvalidInput
from vecenv.util import configs, inputs

# The names that policies use, and MuJoCo's names of the same cameras.
ALIASES: Mapping[str, str] = MappingProxyType({"wrist": "robot0_eye_in_hand"})
# The two cameras that VLA policies are trained on, in their order.
POLICY_CAMERAS = ("agentview", "wrist")
LODS = ("original", "exact", "fast")
ENGINES = ("gl", "raytrace")
COLORS = ("published", "current")
# The limit of MuJoCo's framebuffer and of most drivers.
LARGEST_SIDE = 4096


class RenderError(InvalidInput):
    """A camera, instance, texture or option does not exist; the message names it and those that do."""


@dataclass(frozen=True, kw_only=True)
class UserCamera:
    """An additional camera; poses are in the world frame and may differ between slots.

    Attributes:
        name: its name in the images; no camera of the scene may have it.
        pos: metres, [3] or [B, 3].
        quat: wxyz, [4] or [B, 4]; a camera looks along its -z axis, +y is up.
        fovy: vertical field of view, degrees, one number or [B].
    """

    name: str
    pos: npt.ArrayLike
    quat: npt.ArrayLike
    fovy: npt.ArrayLike = 45.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise RenderError(f"camera {inputs.shown(self.name)}: expected a name")
        for field_name, width in (("pos", 3), ("quat", 4)):
            what, right = f"camera {self.name!r}: {field_name}", f"finite [{width}] or [B, {width}]"
            value = inputs.floats(getattr(self, field_name), what, right, RenderError)
            if value.ndim not in (1, 2) or value.shape[-1] != width or not np.isfinite(value).all():
                raise RenderError(f"{what} must be {right}")
        if (np.linalg.norm(np.asarray(self.quat, float), axis=-1) < 1e-6).any():
            raise RenderError(f"camera {self.name!r}: quat has length 0")
        right = "degrees between 0 and 180"
        fovy = inputs.floats(self.fovy, f"camera {self.name!r}: fovy", right, RenderError)
        if fovy.ndim > 1 or not ((fovy > 0) & (fovy < 180)).all():
            raise RenderError(f"camera {self.name!r}: fovy={inputs.shown(self.fovy)}: need {right}")

    @classmethod
    def looking_at(
        cls,
        name: str,
        eye: npt.ArrayLike,
        target: npt.ArrayLike,
        up: npt.ArrayLike = (0, 0, 1),
        fovy: npt.ArrayLike = 45.0,
    ) -> UserCamera:
        """A camera at ``eye`` [3] that looks at ``target`` [3], both in metres."""
        back = np.asarray(eye, float) - np.asarray(target, float)
        right = np.cross(np.asarray(up, float), back)
        if np.linalg.norm(right) < 1e-9:
            raise RenderError(f"camera {name!r}: it looks along its up direction, or its target is its own position")
        axes = np.stack([_unit(right), _unit(np.cross(back, right)), _unit(back)], axis=1)
        return cls(name=name, pos=np.asarray(eye, float), quat=quat_of(axes), fovy=fovy)

    def in_slot(self, slot: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Position [3], axes in columns [3, 3] and field of view in degrees, in one slot."""

        def own(value: npt.ArrayLike, dims: int) -> np.ndarray:
            array = np.asarray(value, float)
            return array if array.ndim == dims else array[slot]

        return own(self.pos, 1), matrix_of(own(self.quat, 1)), float(own(self.fovy, 0))


@dataclass(frozen=True, kw_only=True)
class CameraShift:
    """Moves a camera in its own frame (x right, y up, looking along -z).

    Attributes:
        pos: metres, [3].
        turn: rotation vector, radians, [3].
        fovy: added to the vertical field of view, degrees.
    """

    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fovy: float = 0.0

    def __post_init__(self) -> None:
        configs.check(self, RenderError, vectors=("pos", "turn"))


@dataclass(frozen=True, kw_only=True)
class VisualOptions:
    """How the images of one slot differ from upstream's; physics and goals do not change. The default changes nothing.

    Attributes:
        light: scale of all light, 1 for no change.
        light_color: scale of red, green and blue light, [3].
        light_shift: moves the lamps, metres, world frame, [3].
        cameras: by camera, how it is moved.
        colors: by instance (an object, a fixture, ``"robot"``) or material, what its red, green, blue are scaled by.
        textures: by material, the scene's texture that it gets.
    """

    light: float = 1.0
    light_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    light_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    cameras: Mapping[str, CameraShift] = field(default_factory=dict)
    colors: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    textures: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if isinstance(self.colors, Mapping):
            scales = {
                name: configs.vector(value, f"colors[{name!r}]", RenderError) for name, value in self.colors.items()
            }
            object.__setattr__(self, "colors", scales)
        configs.check(self, RenderError, vectors=("light_color", "light_shift"))


@dataclass(frozen=True, kw_only=True)
class VisualVariation:
    """Ranges of visual options; ``draw`` samples from them.

    Attributes:
        light: the light's scale lies within 1 plus or minus this.
        light_color: each colour's scale likewise.
        light_shift: largest shift of the lamps along each axis, metres.
        camera_pos: largest shift of a camera along each axis, metres.
        camera_turn: largest rotation of a camera about each axis, radians.
        camera_fovy: largest change of the field of view, degrees.
        cameras: the cameras that move.
        color: scales of the instances' red, green, blue lie within 1 plus or minus this.
        instances: the instances that change colour.
        textures: by material, the textures it may get.
    """

    light: float = 0.0
    light_color: float = 0.0
    light_shift: float = 0.0
    camera_pos: float = 0.0
    camera_turn: float = 0.0
    camera_fovy: float = 0.0
    cameras: Sequence[str] = ("agentview",)
    color: float = 0.0
    instances: Sequence[str] = ()
    textures: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def draw(self, seed: int | Sequence[int]) -> VisualOptions:
        """Sample options; they depend on the seed alone. A seed of (seed, episode) varies them by episode."""
        rng = np.random.default_rng(seed)

        def around(center: float, spread: float) -> tuple[float, float, float]:
            x, y, z = rng.uniform(center - spread, center + spread, 3).tolist()
            return x, y, z

        return VisualOptions(
            light=around(1.0, self.light)[0],
            light_color=around(1.0, self.light_color),
            light_shift=around(0.0, self.light_shift),
            cameras={
                name: CameraShift(
                    pos=around(0.0, self.camera_pos),
                    turn=around(0.0, self.camera_turn),
                    fovy=around(0.0, self.camera_fovy)[0],
                )
                for name in self.cameras
            },
            colors={name: around(1.0, self.color) for name in self.instances},
            textures={name: str(rng.choice(list(choices))) for name, choices in self.textures.items()},
        )


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """How an environment renders.

    Attributes:
        height, width: of every image, pixels.
        lod: ``"exact"``, upstream's image without visible differences; ``"original"``, with every triangle that
            upstream draws; or ``"fast"``, simplified meshes (``vecenv.libero.render.lod``).
        cameras: cameras besides those of the scene.
        gl: ``"egl"``, ``"osmesa"``, or None for the one that ``MUJOCO_GL`` names, else the first that is installed.
        engine: ``"gl"``, upstream's renderer; or ``"raytrace"``, MuJoCo Warp's, which needs no GL and is fast on NVIDIA
            GPUs; its images differ a little, and of visual options it swaps no textures and colours no materials.
        antialias: of ray-traced images: trace edges again with four rays a pixel. Images are 1 to 4 dB closer to GL's
            and take about twice as long. GL always takes four samples.
        num_threads: threads that render with GL, each with a context of its own.
        num_processes: processes that do so in place of threads; only one of the two may be given. With neither,
            threads render where the GL driver draws in software, one per core; where it draws in hardware, processes,
            one per slot and at most one per core (a single slot is rendered by threads).
        colors: ``"published"``, textures as MuJoCo up to 3.3.2 shows them, under which LIBERO's demonstrations were
            rendered and its checkpoints scored; or ``"current"``, as the installed MuJoCo shows them
            (``vecenv.libero.render.colors`` says what differs).
    """

    height: int = 256
    width: int = 256
    lod: str = "exact"
    cameras: Sequence[UserCamera] = ()
    gl: str | None = None
    engine: str = "gl"
    antialias: bool = False
    num_threads: int | None = None
    num_processes: int | None = None
    colors: str = "published"

    def __post_init__(self) -> None:
        configs.check(self, RenderError, ranges={"num_threads": (1, 4096), "num_processes": (1, 4096)})
        check_numbers(self.num_threads, self.num_processes)
        if not (1 <= self.height <= LARGEST_SIDE and 1 <= self.width <= LARGEST_SIDE):
            raise RenderError(f"images of {self.height} x {self.width} pixels: each side must be 1 to {LARGEST_SIDE}")
        if self.lod not in LODS:
            raise RenderError(f"lod={self.lod!r}: expected one of {', '.join(LODS)}")
        if self.engine not in ENGINES:
            raise RenderError(f"engine={self.engine!r}: expected one of {', '.join(ENGINES)}")
        check_colors(self.colors)
        names = [camera.name for camera in self.cameras]
        if len(set(names)) != len(names):
            raise RenderError(f"two cameras have the same name: {', '.join(names)}")


def check_numbers(num_threads: int | None, num_processes: int | None) -> None:
    """Check that threads or processes render.

    Raises:
        RenderError: both numbers are given.
    """
    if num_threads is not None and num_processes is not None:
        raise RenderError(
            f"num_threads={num_threads}, num_processes={num_processes}: threads or processes render, give one of them"
        )


def check_colors(colors: str) -> None:
    """Check the name of a texture decoding.

    Raises:
        RenderError: it does not exist; the message names those that do.
    """
    if colors not in COLORS:
        raise RenderError(f"colors={colors!r}: expected one of {', '.join(COLORS)}")


def matrix_of(quat: npt.ArrayLike) -> np.ndarray:
    """Rotation matrix [3, 3] of a quaternion wxyz [4] of any length but 0."""
    return Rotation.from_quat(np.asarray(quat, float), scalar_first=True).as_matrix()


def quat_of(matrix: npt.ArrayLike) -> np.ndarray:
    """Quaternion wxyz [4] of a rotation matrix [3, 3]."""
    return Rotation.from_matrix(np.asarray(matrix, float)).as_quat(scalar_first=True)


def rotation_of(vector: Sequence[float]) -> np.ndarray:
    """Rotation matrix [3, 3] of a rotation vector [3], radians."""
    return Rotation.from_rotvec(np.asarray(vector, float)).as_matrix()


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
