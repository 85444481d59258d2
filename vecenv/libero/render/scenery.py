"""What a ray tracer draws of a scene, and the file it is kept in.

In: a scene compiled with its visual meshes, or a problem whose scene is compiled. Out: ``Scenery``, a flat model
(``vecenv.libero.render.flatten`` says how it differs from the visual one) with what each of its geoms stands for. The
poses of a physics state, and nothing else, place everything in it.
"""

from __future__ import annotations

import json
import weakref
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from vecenv.libero.render import lod
from vecenv.libero.render.colors import set_decoding
from vecenv.libero.render.flatten import Burner, flatten
from vecenv.libero.render.options import RenderError, check_colors
from vecenv.libero.scene.bddl import Problem, SceneKey
from vecenv.libero.scene.scene import Scene, compile_scene

# Version of the files; it counts up when their contents change.
_VERSION = 4
# Longest side of a texture, texels.
TEXTURE_SIDE = 640


@dataclass(frozen=True, kw_only=True)
class Scenery:
    """What a ray tracer draws of a scene.

    Attributes:
        model: the flat model; its cameras and lights are the scene's.
        instances: the names that segmentation images index; "" (index 0) is everything else.
        instance_of_geom: index into ``instances`` of each geom, int16 [ngeom].
        burners: geoms that are drawn only while a stove is on.
        colors: how textures look, see ``vecenv.libero.render.colors``.
    """

    model: mujoco.MjModel
    instances: tuple[str, ...]
    instance_of_geom: np.ndarray
    burners: tuple[Burner, ...] = ()
    colors: str = "published"

    def check(self, physics: mujoco.MjModel, colors: str | None = None) -> None:
        """Check that the poses of a physics model fit, and that the colours are these, if any are given.

        Raises:
            RenderError: the scene or the colours differ.
        """
        if colors is not None and colors != self.colors:
            raise RenderError(
                f"the scenery was made with colors={self.colors!r} but colors={colors!r} is requested; "
                f"make it anew with installed_scenery(problem, colors={colors!r}), or request colors={self.colors!r}"
            )
        names = [[model.body(body).name for body in range(model.nbody)] for model in (self.model, physics)]
        if names[0] != names[1]:
            raise RenderError("the scenery and the physics model are not of the same scene")

    def save(self, path: str | Path) -> None:
        """Write to a file that this version of MuJoCo can read."""
        buffer = np.zeros(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, buffer)
        about = {"version": _VERSION, "instances": self.instances, "colors": self.colors}
        text = np.array(json.dumps({**about, "burners": [vars(burner) for burner in self.burners]}))
        np.savez_compressed(path, model=buffer, about=text, instance_of_geom=self.instance_of_geom)

    @classmethod
    def load(cls, path: str | Path) -> Scenery:
        """Read what ``save`` wrote.

        Raises:
            OSError: the file cannot be read.
            RenderError: the file is no scenery, or another version of MuJoCo or vecenv wrote it.
        """
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        try:
            about = json.loads(str(arrays["about"]))
            model = mujoco.MjModel.from_binary_path("m", {"m": arrays["model"].tobytes()})
            burners = tuple(Burner(**{**burner, "knobs": tuple(burner["knobs"])}) for burner in about["burners"])
        except (KeyError, ValueError, TypeError) as error:
            raise RenderError(f"{path}: no scenery that MuJoCo {mujoco.__version__} can read") from error
        if about.get("version") != _VERSION:
            raise RenderError(f"{path}: a scenery of another version of vecenv; write it anew")
        return cls(
            model=model,
            instances=tuple(about["instances"]),
            instance_of_geom=arrays["instance_of_geom"],
            burners=burners,
            colors=str(about["colors"]),
        )


def scenery_of(
    scene: Scene,
    *,
    level: str = "fast",
    colors: str = "published",
    texture_side: int = TEXTURE_SIDE,
    join: bool = True,
) -> Scenery:
    """The scenery of a scene.

    Args:
        scene: compiled with ``visual=True``; its meshes are simplified in place.
        level: of detail, see ``vecenv.libero.render.lod``.
        colors: how textures look, ``"published"`` or ``"current"``, see ``vecenv.libero.render.colors``.
        texture_side: longest side of a texture, texels.
        join: whether to join the untextured meshes of a body.

    Raises:
        RenderError: ``colors`` is neither.
    """
    set_decoding(scene.model, colors)
    lod.simplify(scene.model, level)
    flat = flatten(scene, texture_side=texture_side, join=join)
    return Scenery(
        model=flat.model,
        instances=flat.instances,
        instance_of_geom=flat.instance_of_geom,
        burners=flat.burners,
        colors=colors,
    )


def installed_scenery(problem: Problem, level: str = "fast", colors: str = "published") -> Scenery:
    """The scenery of a problem's scene, compiled from the installed packages (10 s); errors of ``compile_scene``."""
    check_colors(colors)
    key = (problem.scene_key(), level, colors)
    scenery = _sceneries.get(key)
    if scenery is None:
        scenery = _sceneries[key] = scenery_of(compile_scene(problem, visual=True), level=level, colors=colors)
    return scenery


# Sceneries stay while something uses them.
_sceneries: weakref.WeakValueDictionary[tuple[SceneKey, str, str], Scenery] = weakref.WeakValueDictionary()
