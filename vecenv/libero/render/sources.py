"""Where images get their models from: the installed packages, or a folder that ``vecenv compile --images`` wrote.

In: a problem, a level of detail and how textures look. Out: the scene that GL draws, or the scenery that rays are
traced in. Both kinds of source give the same bytes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from vecenv.libero.render.colors import visual_scene
from vecenv.libero.render.exported import ExportedVisuals
from vecenv.libero.render.scenery import Scenery, installed_scenery
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.scene import Scene


class VisualSource(Protocol):
    """What an environment draws, by problem."""

    def key(self, problem: Problem) -> object:
        """Problems with equal keys, of all sources, look the same; hashable."""
        ...

    def scene(self, problem: Problem, *, level: str, colors: str) -> Scene:
        """The scene that GL draws, a new one at each call: its user changes it.

        Args:
            problem: whose.
            level: of detail, see ``vecenv.libero.render.lod``.
            colors: how textures look, see ``vecenv.libero.render.colors``.
        """
        ...

    def scenery(self, problem: Problem, *, level: str, colors: str) -> Scenery:
        """What a ray tracer draws; arguments as for ``scene``."""
        ...


class InstalledVisuals:
    """Compiles what it draws from the files of the installed packages; errors of ``compile_scene``."""

    def key(self, problem: Problem) -> object:
        """See `VisualSource`."""
        return problem.scene_key()

    def scene(self, problem: Problem, *, level: str, colors: str) -> Scene:
        """See `VisualSource`."""
        return visual_scene(problem, colors, level)

    def scenery(self, problem: Problem, *, level: str, colors: str) -> Scenery:
        """See `VisualSource`."""
        return installed_scenery(problem, level, colors)


def visual_source(scenes: str | Path | None) -> VisualSource:
    """The source for an environment whose option ``scenes`` this is: a folder, or None for the installed packages.

    Nothing is read before something is drawn.
    """
    return InstalledVisuals() if scenes is None else ExportedVisuals(scenes)
