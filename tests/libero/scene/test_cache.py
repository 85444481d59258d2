"""Compiled scenes on disk: found by content, whole or not at all, never in the way."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from vecenv.libero.scene import cache, goals
from vecenv.libero.scene.arenas import ARENAS
from vecenv.libero.scene.cache import SceneFileError, cached_scene, content_key, read_scene, write_scene
from vecenv.libero.scene.scene import Scene, SceneError, SceneSource, compile_scene, scene_source
from vecenv.libero.tasks import suites
from vecenv.util import caching

PROBLEM = suites.task("libero_goal", 0).problem()
PAIRS = goals.contact_pairs(task.problem() for task in suites.list_tasks("libero_goal"))

CUBE = """<mujoco><asset><mesh name="cube" file="{file}"/></asset>
<worldbody><body><freejoint/><geom type="mesh" mesh="cube"/></body></worldbody></mujoco>"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache; the folder its scenes go to."""
    monkeypatch.setenv(caching.VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache" / "scenes"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return compile_scene(PROBLEM, contact_pairs=PAIRS)


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(source: SceneSource) -> Scene:
        raise AssertionError("the scene was compiled, not read")

    monkeypatch.setattr(SceneSource, "compile", refuse)


def model_bytes(model: mujoco.MjModel) -> bytes:
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def assert_same(one: Scene, other: Scene) -> None:
    assert model_bytes(one.model) == model_bytes(other.model)
    assert (one.problem_name, one.arena) == (other.problem_name, other.arena)
    assert list(one.entities.items()) == list(other.entities.items())
    assert list(one.regions.items()) == list(other.regions.items())


def source_of(xml: str) -> SceneSource:
    name = "libero_floor_manipulation"
    return SceneSource(problem_name=name, xml=xml, arena=ARENAS[name], entities={}, regions={}, origin="cube.bddl")


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_scene_that_was_read_is_the_scene_that_was_compiled(folder: Path, scene: Scene) -> None:
    assert_same(cached_scene(PROBLEM, contact_pairs=PAIRS), scene)
    assert_same(cached_scene(PROBLEM, contact_pairs=PAIRS), scene)


def test_a_scene_is_two_files_named_after_its_content(folder: Path) -> None:
    cached_scene(PROBLEM, contact_pairs=PAIRS)
    key = content_key(scene_source(PROBLEM, contact_pairs=PAIRS))
    assert names_in(folder) == {f"{key}.mjb", f"{key}.json"}


def test_a_cached_scene_is_not_compiled(folder: Path, scene: Scene, no_compiler: None) -> None:
    write_scene(folder, content_key(scene_source(PROBLEM, contact_pairs=PAIRS)), scene)
    assert_same(cached_scene(PROBLEM, contact_pairs=PAIRS), scene)
    with pytest.raises(AssertionError, match="compiled, not read"):
        cached_scene(PROBLEM)  # without the contact sensors it is another scene


def test_the_key_follows_the_content_of_the_files_and_not_their_place(tmp_path: Path) -> None:
    keys = []
    for place, text in (("here", TETRAHEDRON), ("over & there", TETRAHEDRON), ("other", TETRAHEDRON + "# taller\n")):
        mesh = tmp_path / place / "cube.obj"
        mesh.parent.mkdir()
        mesh.write_text(text)
        keys.append(content_key(source_of(CUBE.format(file=str(mesh).replace("&", "&amp;")))))
    assert keys[0] == keys[1] != keys[2]


def test_a_file_that_changes_changes_the_key(tmp_path: Path) -> None:
    mesh = tmp_path / "cube.obj"
    mesh.write_text(TETRAHEDRON)
    before = content_key(source_of(CUBE.format(file=mesh)))
    mesh.write_text(TETRAHEDRON.replace("v 0 0 1", "v 0 0 22"))
    assert content_key(source_of(CUBE.format(file=mesh))) != before


def test_the_key_follows_text_names_mujoco_and_layout(monkeypatch: pytest.MonkeyPatch) -> None:
    source = scene_source(PROBLEM)
    renamed = SceneSource(**{**vars(source), "regions": dict(list(source.regions.items())[1:])})
    keys = {content_key(each) for each in (source, renamed, scene_source(PROBLEM, contact_pairs=PAIRS))}
    monkeypatch.setattr(mujoco, "__version__", "3.99.0")
    keys.add(content_key(source))
    monkeypatch.setattr(cache, "FORMAT", cache.FORMAT + 1)
    keys.add(content_key(source))
    assert len(keys) == 5


def truncate(model: Path, description: Path) -> None:
    model.write_bytes(model.read_bytes()[:1000])


def flip_a_bit(model: Path, description: Path) -> None:
    data = bytearray(model.read_bytes())
    data[len(data) // 2] ^= 1
    model.write_bytes(data)


def lose_the_model(model: Path, description: Path) -> None:
    model.unlink()


def empty_the_description(model: Path, description: Path) -> None:
    description.write_text("")


def describe_something_else(model: Path, description: Path) -> None:
    description.write_text('["a", "list"]')


def rename_a_body(model: Path, description: Path) -> None:
    description.write_text(description.read_text().replace("akita_black_bowl_1_main", "akita_black_bowl_2_main"))


def claim_another_mujoco(model: Path, description: Path) -> None:
    description.write_text(json.dumps({**json.loads(description.read_text()), "mujoco": "3.2.0"}))


DAMAGE = [
    (truncate, r"\.mjb: damaged"),
    (flip_a_bit, r"\.mjb: damaged"),
    (lose_the_model, r"\.mjb: cannot be read: No such file"),
    (empty_the_description, r"\.json: damaged: not the description of a scene"),
    (describe_something_else, r"\.json: damaged: not the description of a scene"),
    (rename_a_body, r"\.mjb: damaged: it and .*\.json do not belong together"),
    (claim_another_mujoco, r"\.mjb: compiled by MuJoCo 3\.2\.0 .* but this is MuJoCo"),
]


@pytest.mark.parametrize(("damage", "says"), DAMAGE, ids=[damage.__name__ for damage, _ in DAMAGE])
def test_a_damaged_entry_is_named_compiled_again_and_replaced(
    folder: Path, scene: Scene, damage: Callable[[Path, Path], None], says: str
) -> None:
    key = content_key(scene_source(PROBLEM, contact_pairs=PAIRS))
    write_scene(folder, key, scene)
    damage(folder / f"{key}.mjb", folder / f"{key}.json")
    with pytest.raises(SceneFileError, match=says):
        read_scene(folder, key)
    assert_same(cached_scene(PROBLEM, contact_pairs=PAIRS), scene)
    assert_same(read_scene(folder, key), scene)


def test_a_folder_in_the_place_of_a_file_is_not_in_the_way(folder: Path, scene: Scene) -> None:
    key = content_key(scene_source(PROBLEM, contact_pairs=PAIRS))
    (folder / f"{key}.mjb").mkdir(parents=True)
    assert_same(cached_scene(PROBLEM, contact_pairs=PAIRS), scene)
    assert names_in(folder) == {f"{key}.mjb"}


def test_a_folder_that_cannot_be_written_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scene: Scene
) -> None:
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv(caching.VARIABLE, str(tmp_path / "file" / "cache"))
    assert_same(cached_scene(PROBLEM, contact_pairs=PAIRS), scene)


def test_the_cache_can_be_turned_off(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scene: Scene) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv(caching.VARIABLE, "")
    assert caching.folder("scenes") is None
    assert_same(cached_scene(PROBLEM, contact_pairs=PAIRS), scene)
    assert not names_in(tmp_path)


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME is Linux's name for the user's cache folder")
def test_scenes_go_to_the_users_cache_folder_by_default(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(caching.VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert caching.folder("scenes") == tmp_path / "vecenv" / "scenes"


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    caching.write_file(tmp_path / "scene", b"old")

    def full(path: Path, data: bytes) -> int:
        with path.open("wb") as file:
            file.write(data[:1])
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="no space left"):
        caching.write_file(tmp_path / "scene", b"new")
    assert (tmp_path / "scene").read_bytes() == b"old"
    assert names_in(tmp_path) == {"scene"}


def test_a_missing_mesh_is_reported_as_it_is_without_a_cache(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = source_of(CUBE.format(file=tmp_path / "lost.obj"))
    monkeypatch.setattr(cache, "scene_source", lambda problem, **_: lost)
    with pytest.raises(SceneError, match=r"cube\.bddl: MuJoCo rejects the scene: .*lost\.obj"):
        cached_scene(PROBLEM)


def test_processes_that_compile_the_same_scene_do_not_disturb_each_other(folder: Path) -> None:
    code = (
        "from vecenv.libero.scene import cache\n"
        "from vecenv.libero.tasks import suites\n"
        "from vecenv.util import caching\n"
        "for _ in range(5):\n"
        "    cache.cached_scene(suites.task('libero_goal', 0).problem())\n"
        "    [path.unlink(missing_ok=True) for path in caching.folder('scenes').glob('*.json')]\n"
        "cache.cached_scene(suites.task('libero_goal', 0).problem())\n"
    )
    workers = [subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True) for _ in range(3)]
    assert [(worker.communicate()[1], worker.returncode) for worker in workers] == [("", 0)] * 3
    key = content_key(scene_source(PROBLEM))
    assert names_in(folder) <= {f"{key}.mjb", f"{key}.json"}
    assert_same(cached_scene(PROBLEM), compile_scene(PROBLEM))
