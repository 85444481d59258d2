"""Write ``vecenv/simpler/assets/manifest.json``: the files that SIMPLER's tasks open, with their sizes and hashes; and
``manifest_variants.json``, those that only variant aggregation opens.

In: an asset tree in the layout of ManiSkill2_real2sim, and a clone of that repository. Every file of the tree is
listed, and must have the content that the repository's commit has at that path. Files that the tasks open but the tree
does not have (some meshes, and the textures beside them) are read from the clone; if a partial clone does not have one
either, Git's identifier of the content is recorded alone, which still verifies a download.

    python scripts/simpler_manifest.py TREE --git CLONE [--commit COMMIT]
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import os
import subprocess
import sys
from pathlib import Path, PurePosixPath

from vecenv.simpler.assets import files as assets
from vecenv.simpler.models import model_folder
from vecenv.simpler.published.lists import ROOMS
from vecenv.simpler.task_spec import DATA, StageSpec
from vecenv.simpler.task_table import COKE_TABLE, PLAIN_TRIPLETS
from vecenv.simpler.tasks import TASKS
from vecenv.simpler.variants import DISTRACTORS, STAGES

COMMIT = "ef7a4d4fdf4b69f2c2154db5b15b9ac8dfe10682"
# Objects that move_near and pick draw from a mesh in a file of this name; the others' are in the tree.
_MISSING_VISUALS = (
    "baked_opened_redbull_can",
    "baked_opened_redbull_can_v2",
    "blue_plastic_bottle",
    "eggplant",
    "opened_redbull_can",
    "redbull_can",
)


def main() -> None:
    """Read the arguments, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tree", type=Path)
    parser.add_argument("--git", type=Path, required=True, help="clone of ManiSkill2_real2sim")
    parser.add_argument("--commit", default=COMMIT)
    parser.add_argument("--out", type=Path, default=assets.MANIFEST)
    parser.add_argument("--variants", type=Path, default=assets.VARIANTS_MANIFEST)
    options = parser.parse_args()
    blobs = git_blobs(options.git, options.commit)
    there = files(options.tree)
    varied: dict[str, str | None] = dict.fromkeys(variant_files(blobs, there))
    tasks = {**needed(blobs), **dict.fromkeys(path for path in there if path not in varied)}
    for out, wanted in ((options.out, tasks), (options.variants, varied)):
        write(out, options.commit, [row(options, path, blobs, wanted[path]) for path in sorted(wanted)])


def write(out: Path, commit: str, rows: list[dict[str, str | int]]) -> None:
    """A manifest, and a word about it."""
    lines = ",\n  ".join(json.dumps(entry) for entry in rows)
    out.write_text(f'{{"commit": "{commit}", "files": [\n  {lines}\n]}}\n')
    absent = [str(entry["path"]) for entry in rows if "sha256" not in entry]
    print(f"{len(rows)} files, {len(absent)} of them only with Git's identifier:", *absent, sep="\n  ")


def variant_files(blobs: dict[str, str], tree: list[str]) -> list[str]:
    """Tables and rooms of variant aggregation, the mesh of one of its cabinets, and what its objects are drawn with."""
    tables = [StageSpec(name=name, offset=COKE_TABLE.offset) for name in STAGES]
    meshes = [str(stage.mesh) for stage in (*tables, *ROOMS.values())]
    models = {*itertools.chain(*PLAIN_TRIPLETS, *DISTRACTORS.values())} - set(_MISSING_VISUALS)
    folders = tuple(f"{model_folder(model)}/" for model in models)
    drawn = [path for path in blobs if path.startswith(folders) and path.endswith((".dae", ".png", ".jpg"))]
    return [*meshes, f"{DATA}/custom/models/stone_tabletop.glb", *(path for path in drawn if path not in tree)]


def files(tree: Path) -> list[str]:
    """Files of the tree, relative."""
    return [file.relative_to(tree).as_posix() for file in tree.rglob("*") if file.is_file()]


def needed(blobs: dict[str, str]) -> dict[str, str | None]:
    """Files that the tasks open and that a tree may lack -> the file that uses them, None for the simulator itself."""
    found: dict[str, str | None] = {str(task.stage.mesh): None for task in TASKS.values() if task.stage.mesh}
    for model in _MISSING_VISUALS:
        folder = f"data/custom/models/{model}/"
        mesh = f"{folder}textured.dae"
        images = [path for path in blobs if path.startswith(folder) and path.endswith((".png", ".jpg"))]
        found |= {mesh: None, **dict.fromkeys(images, mesh)}
    return found


def git_blobs(clone: Path, commit: str) -> dict[str, str]:
    """Path -> Git's identifier of its content, in a commit."""
    listed = _git(clone, "ls-tree", "-r", commit)
    assert listed is not None, f"{clone} has no commit {commit}"
    return {line.partition("\t")[2]: line.split()[2] for line in listed.decode().splitlines()}


def row(options: argparse.Namespace, path: str, blobs: dict[str, str], used_by: str | None) -> dict[str, str | int]:
    """One line of the manifest."""
    if path not in blobs:
        sys.exit(f"{path} is not in the repository's commit")
    content = _content(options, path, blobs[path])
    use = {"used_by": used_by} if used_by else {}
    if content is None:
        return {"path": path, "git_blob": blobs[path], **use}
    return {"path": path, "size": len(content), "sha256": hashlib.sha256(content).hexdigest(), **use}


def _content(options: argparse.Namespace, path: str, blob: str) -> bytes | None:
    file = options.tree / path
    if not file.is_file():
        return _git(options.git, "cat-file", "blob", blob)
    if not assets.Entry(path=PurePosixPath(path), git_blob=blob).matches(file):
        sys.exit(f"{file} is not the file of the repository's commit")
    return file.read_bytes()


def _git(clone: Path, *arguments: str) -> bytes | None:
    """The output of git; None if it fails. A partial clone must not fetch missing objects."""
    command = ["git", "-C", str(clone), *arguments]
    done = subprocess.run(command, check=False, capture_output=True, env={**os.environ, "GIT_NO_LAZY_FETCH": "1"})
    return done.stdout if done.returncode == 0 else None


if __name__ == "__main__":
    main()
