"""A folder that ``vecenv compile --images`` wrote is drawn as the installed packages are, byte for byte."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from typer.testing import CliRunner, Result

import vecenv
from vecenv.cli import COMMAND_GROUP, build_app
from vecenv.libero.functional import FunctionalConfig, FunctionalLibero
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.render import exported as exported_module
from vecenv.libero.render.exported import ExportedVisuals, export_images, looks
from vecenv.libero.render.options import RenderConfig
from vecenv.libero.render.packing import PackingError, Pieces
from vecenv.libero.render.sources import InstalledVisuals
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.tasks.export import ExportError, ExportFolder, export
from vecenv.libero.tasks.seal import write_seal
from vecenv.libero.tasks.suites import list_tasks

SUITE = "libero_goal"  # its ten tasks share one scene
LOOKS = looks(["gl", "raytrace"], ["fast"])
BUDGET = Budget(contacts=100, rows=400, pairs=100, candidates=200)

DRAW = """
import hashlib, json, sys
import jax, numpy as np
import vecenv
from vecenv.libero.functional import FunctionalConfig, FunctionalLibero
from vecenv.libero.render.options import RenderConfig

def digest(*arrays):
    return [hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest() for array in arrays]

def draw(scenes):
    found = []
    for engine, size in (("gl", 64), ("raytrace", 16)):
        render = RenderConfig(height=size, width=size, lod="fast", engine=engine)
        env = vecenv.make("libero_goal", task=3, episodes=[0, 1], render=render, scenes=scenes)
        env.reset()
        env.step_continuous(np.full((2, 7), 0.5))
        seen = env.observe_egocentric()
        found.append(digest(*seen.observation, seen.depth, seen.segmentations["wrist"], seen.views["wrist"].mat))
        found.append([int(np.unique(image).size > 20) for image in seen.observation])
        env.close()
    return found
"""
HIDDEN = """
from vecenv.assets import AssetsMissing
found = draw(sys.argv[1])
try:
    vecenv.make("libero_goal", task=0)
except AssetsMissing:
    print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A suite with images, exported once; tests that damage it take a copy."""
    made = tmp_path_factory.mktemp("export") / "libero"
    export(made, [SUITE])
    export_images(made, LOOKS, [SUITE])
    return made


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return shutil.copytree(folder, tmp_path / "copy")


def the_problem() -> Problem:
    return list_tasks(SUITE)[0].problem()


def the_file(folder: Path, engine: str) -> Path:
    (entry,) = json.loads((folder / "images" / "index.json").read_bytes())["scenes"].values()
    return folder / "images" / entry[f"{engine} fast published"]["file"]


def arrays_of(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    named = ((name, getattr(model, name)) for name in dir(model) if not name.startswith("_"))
    return {name: value for name, value in named if isinstance(value, np.ndarray)}


@pytest.mark.heavy
def test_without_the_packages_images_are_bit_identical(folder: Path, tmp_path: Path) -> None:
    variables = ("VECENV_LIBERO_ROOT", "VECENV_LIBERO_ASSETS", "VECENV_ROBOSUITE_ASSETS")
    environment = {**os.environ, **dict.fromkeys(variables, str(tmp_path))}
    command = [sys.executable, "-c", DRAW + HIDDEN, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    here: dict[str, Any] = {}
    exec(DRAW, here)
    theirs, ours = json.loads(done.stdout.splitlines()[-1]), here["draw"](None)
    assert theirs == ours
    assert ours[1] == ours[3] == [1, 1]  # they show something


@pytest.mark.parametrize("engine", ["gl", "raytrace"])
def test_what_is_read_has_every_array_that_drawing_reads(folder: Path, engine: str) -> None:
    name = "scene" if engine == "gl" else "scenery"
    wanted, found = (
        getattr(source, name)(the_problem(), level="fast", colors="published")
        for source in (InstalledVisuals(), ExportedVisuals(folder))
    )
    assert not [
        field
        for field, value in arrays_of(wanted.model).items()
        if not field.startswith("bvh_")
        and not np.array_equal(value, getattr(found.model, field), equal_nan=value.dtype.kind == "f")
    ]
    assert wanted.model.names == found.model.names
    if engine == "raytrace":
        assert (wanted.instances, wanted.burners) == (found.instances, found.burners)
        np.testing.assert_array_equal(wanted.instance_of_geom, found.instance_of_geom)
    else:
        assert (wanted.entities, wanted.regions) == (found.entities, found.regions)


def test_the_functional_environment_takes_its_scenery_from_the_folder(folder: Path) -> None:
    config = FunctionalConfig(impl="warp", obs=("pixels",), image_size=8, scenes=str(folder), budget=BUDGET)
    env = FunctionalLibero(SUITE, task=0, config=config)
    assert env.observation_size["pixels/view_0"] == (8, 8, 3)


def test_two_engines_share_files(folder: Path) -> None:
    names = [
        [part[-1] for part in json.loads(the_file(folder, engine).read_bytes())["model"]["parts"]]
        for engine in ("gl", "raytrace")
    ]
    assert len(set(names[0])) > 20
    assert {path.name for path in (folder / "images" / "pieces").iterdir()} > {*names[0], *names[1]}


def test_suites_that_share_a_scene_share_its_images(copy: Path) -> None:
    before = sorted(path.name for path in copy.glob("images/**/*"))
    done = export_images(copy, LOOKS, [SUITE, "libero_goal_task"])
    assert done.scenes == 1
    assert sorted(path.name for path in copy.glob("images/**/*")) == before


# -- what a folder lacks -----------------------------------------------------------------------------------------------


def drawn(folder: Path, **options: object) -> np.ndarray:
    render = RenderConfig(**{"height": 16, "width": 16, "lod": "fast", "num_threads": 1, **options})  # type: ignore[arg-type]
    env = vecenv.make(SUITE, task=0, episodes=[0], scenes=folder, render=render)
    try:
        env.reset()
        return env.observe_egocentric().rgb
    finally:
        env.close()


def test_a_look_that_was_not_exported_says_which_flags_add_it(folder: Path) -> None:
    command = rf"run `vecenv compile --out {folder} --suite {SUITE} --images gl --lod exact"
    with pytest.raises(ExportError, match=rf"holds no images .*lod='exact', colors='published'; {command}`"):
        drawn(folder, lod="exact")
    with pytest.raises(ExportError, match="--images gl --lod fast --colors current`"):
        drawn(folder, colors="current")
    with pytest.raises(ExportError, match="--images raytrace --lod original`"):
        drawn(folder, engine="raytrace", lod="original")


def test_a_folder_without_images_says_which_flags_add_them(copy: Path) -> None:
    shutil.rmtree(copy / "images")
    write_seal(copy)
    with pytest.raises(ExportError, match=r"--images gl --lod fast`, where LIBERO's packages are installed"):
        drawn(copy)
    config = FunctionalConfig(impl="warp", obs=("pixels",), scenes=str(copy), budget=BUDGET)
    with pytest.raises(ExportError, match="--images raytrace --lod fast`"):
        FunctionalLibero(SUITE, task=0, config=config)


# -- damage ------------------------------------------------------------------------------------------------------------


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def edit_index(folder: Path, **changes: object) -> None:
    path = folder / "images" / "index.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def a_piece(folder: Path) -> Path:
    part = json.loads(the_file(folder, "gl").read_bytes())["model"]["parts"][-1]
    return folder / "images" / "pieces" / part[-1]


def swap_pieces(folder: Path) -> None:
    others = [path for path in (folder / "images" / "pieces").iterdir() if path != a_piece(folder)]
    shutil.copy(others[0], a_piece(folder))


DAMAGES: list[tuple[Callable[[Path], None], str]] = [
    (lambda folder: cut(folder / "images" / "index.json"), r"images/index\.json: damaged: not the index of images"),
    (lambda folder: edit_index(folder, scenes=[]), r"images/index\.json: damaged"),
    (lambda folder: edit_index(folder, mujoco="3.16.1"), r"images/index\.json: written with MuJoCo 3\.16\.1"),
    (lambda folder: edit_index(folder, format=0), r"index\.json: .*in layout 0"),
    (lambda folder: the_file(folder, "gl").unlink(), r"\.json: cannot be read: No such file"),
    (lambda folder: cut(the_file(folder, "gl")), r"\.json: damaged: not the file that images/index\.json names"),
    (lambda folder: a_piece(folder).unlink(), r"pieces/[0-9a-f]+: cannot be read: No such file"),
    (lambda folder: cut(a_piece(folder)), r"pieces/[0-9a-f]+: damaged"),
    (swap_pieces, r"pieces/[0-9a-f]+: damaged"),
]


@pytest.mark.parametrize(("damage", "says"), DAMAGES)
def test_damage_is_found_and_named(copy: Path, damage: Callable[[Path], None], says: str) -> None:
    damage(copy)
    with pytest.raises(ExportError, match=r"images/.*; run `vecenv compile --out .*again"):
        ExportedVisuals(copy).scene(the_problem(), level="fast", colors="published")
    write_seal(copy)  # what was sealed damaged is found as well
    with pytest.raises(ExportError, match=rf"{says}.*; run `vecenv compile --out .*again"):
        ExportedVisuals(copy).scene(the_problem(), level="fast", colors="published")


def test_an_export_repairs_damage(copy: Path) -> None:
    cut(a_piece(copy))
    cut(the_file(copy, "raytrace"))
    cut(copy / "images" / "index.json")
    export_images(copy, LOOKS, [SUITE])
    ExportedVisuals(copy).scene(the_problem(), level="fast", colors="published")


def test_an_interrupted_export_is_completed(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    index = folder / "images" / "index.json"
    part = tmp_path / "part"
    shutil.copytree(folder, part)
    (part / "images" / "index.json").unlink()

    (part / the_file(folder, "raytrace").relative_to(folder)).unlink()
    made = []

    def noted(problem: Problem, look: exported_module.Look) -> object:
        made.append(look.engine)
        return drawing(problem, look)

    drawing = exported_module._drawn
    monkeypatch.setattr(exported_module, "_drawn", noted)
    export_images(part, LOOKS, [SUITE])
    assert made == ["raytrace"]
    assert (part / "images" / "index.json").read_bytes() == index.read_bytes()


def test_other_looks_stay_when_one_is_added(copy: Path) -> None:
    export_images(copy, looks(["raytrace"], ["fast"], ["current"]), [SUITE])
    (entry,) = json.loads((copy / "images" / "index.json").read_bytes())["scenes"].values()
    assert set(entry) == {"gl fast published", "raytrace fast published", "raytrace fast current"}
    assert ExportedVisuals(copy).scenery(the_problem(), level="fast", colors="current").colors == "current"


# -- packing -----------------------------------------------------------------------------------------------------------


def test_any_array_comes_back_from_its_differences(tmp_path: Path) -> None:
    rng, pieces = np.random.default_rng(0), Pieces(tmp_path)
    for rows in (
        rng.integers(0, 256, (701, 3)).astype(np.uint8),
        rng.normal(size=(33, 3)).astype(np.float32),
        rng.integers(-(2**31), 2**31, (5, 2)).astype(np.int32),
    ):
        key = pieces._put(rows)
        np.testing.assert_array_equal(pieces._get(key, rows.shape[1], rows.dtype), rows)
        with pytest.raises(PackingError, match="damaged"):
            pieces._get(key, rows.shape[1] + 1, rows.dtype)


# -- the command -------------------------------------------------------------------------------------------------------


def compile_command(*arguments: str | Path) -> Result:
    compiling = EntryPoint("compile", "vecenv.libero.cli:compile_command", COMMAND_GROUP)
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app([compiling]), ["compile", *map(str, arguments)])


def test_the_command_adds_images(copy: Path) -> None:
    done = compile_command("--out", copy, "--suite", SUITE, "--images", "gl", "--images", "raytrace", "--lod", "fast")
    assert done.exit_code == 0, done.output
    assert "images (gl fast published, raytrace fast published): scenes: 1, " in done.stdout


def test_the_command_that_an_error_names_is_understood(copy: Path) -> None:
    command = ExportFolder(copy).command("--images raytrace --lod fast")
    assert compile_command(*command.split()[2:]).exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--images", "vulkan"], "engine='vulkan': expected one of gl, raytrace"),
        (["--images", "gl", "--lod", "best"], "lod='best': expected one of"),
        (["--images", "gl", "--colors", "dark"], "colors='dark': expected one of"),
        (["--lod", "fast"], "--lod: a level of detail of images, which --images asks for"),
    ],
)
def test_the_command_refuses_looks_that_do_not_exist(tmp_path: Path, arguments: list[str], says: str) -> None:
    done = compile_command("--out", tmp_path / "out", "--suite", SUITE, *arguments)
    assert done.exit_code == 2
    assert says in done.stderr
    assert not (tmp_path / "out").exists()
