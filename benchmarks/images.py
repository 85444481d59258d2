"""Images against upstream's own under the MuJoCo that LIBERO was published with: the table of docs/rendering.md.

    python benchmarks/images.py [--peer .venv-upstream/bin/python] [--scenes libero_goal-0 ...] [--rays all]

The peer's Python writes upstream's images and the states they show to a folder (``benchmarks/images_peer.py``, once);
the same states, fixtures in the same places, are then shown by vecenv, and each image is compared. A scene's number is
its worst image's: two cameras, the start and a state in motion; ``_shuffled`` is a third state, every hinge and slide
somewhere else. ``exact`` and ``fast`` are levels of detail in GL; ``rays`` is ``engine="raytrace"``, slow on a CPU and
by default run in one scene of each workspace; ``current`` is what the installed MuJoCo shows, for comparison.
"""

from __future__ import annotations

import argparse
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from common import ROOT, report
from images_peer import MOMENTS
from support.images import Reference, agreement

from vecenv.libero.render.gl import choose
from vecenv.libero.render.options import RenderConfig
from vecenv.libero.scene.bddl import SceneKey
from vecenv.libero.tasks import suites

PUBLISHED = "3.3.0"
REFERENCES = ROOT / "build" / "upstream_images"
# Moments of a rollout, the first two. In the third the wrist camera looks anywhere: from below a table, at the sky. It
# is there to find what MuJoCo changed, in every detail; what simplified meshes show then is reported and not promised.
ROLLOUT = 2
# What the project promises of every image, dB.
ENOUGH = {"exact": 40.0, "exact_shuffled": 40.0, "fast": 32.0, "rays": 24.0}
COLUMNS = ("exact", "exact_shuffled", "fast", "fast_shuffled", "rays", "current")
RENDER = {
    "exact": RenderConfig(lod="exact"),
    "fast": RenderConfig(lod="fast"),
    "rays": RenderConfig(lod="fast", engine="raytrace"),
    "current": RenderConfig(lod="exact", colors="current"),
}


def scenes() -> dict[str, str]:
    """The distinct scenes of all suites, LIBERO-PRO's too, by the first task of each: the name of its workspace."""
    found: dict[SceneKey, tuple[str, str]] = {}
    for suite in suites.list_suites():
        for task in suites.list_tasks(suite):
            problem = task.problem()
            found.setdefault(problem.scene_key(), (f"{suite}-{task.index}", problem.name))
    return dict(found.values())


def add_peer(parser: argparse.ArgumentParser) -> None:
    """The option that names the peer's Python."""
    told = f"Python of an environment with mujoco {PUBLISHED} and LIBERO; that of `make upstream` by default"
    parser.add_argument("--peer", type=Path, default=ROOT / ".venv-upstream" / "bin" / "python", help=told)


def write_references(peer: Path, folder: Path, names: Sequence[str]) -> None:
    """Have the peer write the files that are not there; the GL is the one that vecenv draws with.

    Raises:
        SystemExit: there is no such Python.
    """
    if not peer.is_file():
        raise SystemExit(f"{peer}: no such file; `make upstream` makes the environment, or name one with --peer")
    script = Path(__file__).with_name("images_peer.py")
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    command = [str(peer), str(script), "--out", str(folder), "--mujoco", PUBLISHED, *names]
    subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": paths, "MUJOCO_GL": choose()})


def row(name: str, workspace: str, reference: Reference, kinds: Sequence[str]) -> dict[str, Any]:
    """The worst image of each kind: of the two moments of a rollout, and in GL of the third."""
    short = workspace.removeprefix("libero_").removesuffix("_manipulation")
    found: dict[str, Any] = {"scene": name, "workspace": short, **dict.fromkeys(COLUMNS)}
    for kind in kinds:
        moments = range(ROLLOUT if kind == "rays" else len(MOMENTS))
        seen = agreement(reference.drawn(RENDER[kind], moments), reference.images[moments]).min(axis=1)
        found[kind] = round(float(seen[:ROLLOUT].min()), 1)
        if f"{kind}_shuffled" in found:
            found[f"{kind}_shuffled"] = round(float(seen[ROLLOUT]), 1)
    print(found, flush=True)
    return found


def kinds_of(name: str, traced: set[str]) -> list[str]:
    """What is compared in a scene."""
    own = name.rsplit("-", 1)[0] in suites.BASE_SUITES
    return ["exact", "fast"] + ["current"] * own + ["rays"] * (name in traced)


def first_of_each(workspaces: dict[str, str]) -> set[str]:
    """The first scene of each workspace."""
    first: dict[str, str] = {}
    for name, workspace in workspaces.items():
        first.setdefault(workspace, name)
    return set(first.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_peer(parser)
    parser.add_argument("--references", type=Path, default=REFERENCES, help="folder of upstream's images")
    parser.add_argument("--scenes", nargs="+", metavar="SUITE-TASK", help="which scenes; all of them by default")
    parser.add_argument("--rays", choices=("workspaces", "all", "none"), default="workspaces")
    parser.add_argument("--out", default="images", help="name of the result file")
    options = parser.parse_args()
    every = scenes()
    names = options.scenes or list(every)
    if unknown := [name for name in names if name not in every]:
        parser.error(f"no scene {unknown[0]!r}; there are {', '.join(every)}")
    write_references(options.peer, options.references, names)
    traced = {"all": set(names), "none": set(), "workspaces": first_of_each({name: every[name] for name in names})}
    rows = [
        row(name, every[name], Reference.load(options.references, name), kinds_of(name, traced[options.rays]))
        for name in names
    ]
    found = {kind: [(each[kind], each["scene"]) for each in rows if each[kind] is not None] for kind in COLUMNS}
    lowest = {kind: min(pairs) for kind, pairs in found.items() if pairs}
    notes = {
        "upstream_mujoco": PUBLISHED,
        "unit": f"dB, a scene's worst image of {', '.join(MOMENTS[:ROLLOUT])}; *_shuffled: of {MOMENTS[ROLLOUT]}",
        "lowest": lowest,
    }
    report(options.out, rows, title=f"Images against upstream under MuJoCo {PUBLISHED}", notes=notes)
    if failed := {kind: lowest[kind] for kind in ENOUGH if kind in lowest and lowest[kind][0] < ENOUGH[kind]}:
        raise SystemExit(f"below what is promised: {failed}")


if __name__ == "__main__":
    main()
