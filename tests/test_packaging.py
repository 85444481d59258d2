"""What pyproject.toml declares is what a wheel has: packages with all their data, commands, supported versions."""

from __future__ import annotations

import importlib
import importlib.util
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hatchling.builders.wheel import WheelBuilder

# Files that code opens by name at run time, one of each kind.
DATA = (
    "vecenv/py.typed",
    "vecenv/libero/render/simplified.npz",
    "vecenv/libero/tasks/settled_starts/libero_10.npz",
    "vecenv/simpler/assets/manifest.json",
    "vecenv_eval/py.typed",
    "vecenv_eval/report/page.html.j2",
    "vecenv_eval/web/static/index.html",
    "vecenv_eval/web/static/app.js",
    "voxposer/perception/catalogue.json",
    "voxposer/prompts/planner.txt",
    "voxposer/py.typed",
    "voxposer/show.html.j2",
)


@pytest.fixture(scope="module")
def scripts() -> dict[str, ModuleType]:
    """``scripts/dist.py`` and ``scripts/audit.py``, which are in no package."""
    folder = Path(__file__).parent.parent / "scripts"
    modules = {}
    for name in ("dist", "audit"):
        spec = importlib.util.spec_from_file_location(f"vecenv_scripts_{name}", folder / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(modules[name])
    return modules


@pytest.fixture
def project(repository: Path) -> dict[str, Any]:
    return tomllib.loads((repository / "pyproject.toml").read_text())["project"]


def test_the_build_takes_every_file_of_the_packages_and_no_other(
    repository: Path, scripts: dict[str, ModuleType]
) -> None:
    chosen = {each.distribution_path for each in WheelBuilder(str(repository)).recurse_included_files()}
    assert set(DATA) <= chosen
    assert chosen == scripts["dist"].in_wheel(scripts["dist"].tracked_files(repository))


def test_commands_name_functions_that_exist(project: dict[str, Any]) -> None:
    targets = [*project["scripts"].values(), *project["entry-points"]["vecenv.commands"].values()]
    for target in targets:
        module, _, name = target.partition(":")
        assert hasattr(importlib.import_module(module), name), target


def test_classifiers_name_the_pythons_that_may_install_it(project: dict[str, Any]) -> None:
    named = [re.fullmatch(r"Programming Language :: Python :: 3\.(\d+)", line) for line in project["classifiers"]]
    minors = [int(found[1]) for found in named if found]
    assert minors == list(range(minors[0], minors[0] + len(minors)))
    assert project["requires-python"] == f">=3.{minors[0]}"


def test_imports_without_extras_need_the_core_only() -> None:
    """The packages themselves import nothing that an extra installs; ``scripts/dist.py`` tries it without extras."""
    code = "import sys, vecenv, voxposer, vecenv_eval; print(*sorted({name.split('.')[0] for name in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert {"vecenv", "voxposer", "vecenv_eval"} <= loaded
    extras = {
        "fastapi",
        "pydantic",
        "h5py",
        "jinja2",
        "plotly",
        "av",
        "sapien",
        "warp",
        "ray",
        "litellm",
        "zmq",
        "yaml",
    }
    assert loaded.isdisjoint(extras)


# ---------------------------------------------------------------------------------------------------------------------
# The checks of built files.


def write_wheel(path: Path, names: list[str], commands: str = "[console_scripts]\nvecenv = vecenv.cli:main\n") -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name in [*names, *(f"vecenv-1.dist-info/{part}" for part in ("METADATA", "RECORD", "licenses/LICENSE"))]:
            archive.writestr(name, "")
        archive.writestr("vecenv-1.dist-info/entry_points.txt", commands)
    return path


FILES = ["vecenv/cli.py", "vecenv/py.typed", "voxposer/py.typed", "eval/vecenv_eval/py.typed"]
PACKED = [name.removeprefix("eval/") for name in FILES]


def test_a_complete_wheel_passes(tmp_path: Path, scripts: dict[str, ModuleType]) -> None:
    scripts["dist"].check_wheel(write_wheel(tmp_path / "w.whl", PACKED), FILES)


@pytest.mark.parametrize(
    ("names", "commands", "message"),
    [
        (PACKED[:-1], "", "1 files are missing: vecenv_eval/py.typed"),
        ([*PACKED, "tests/test_cli.py"], "", "1 files do not belong there: tests/test_cli.py"),
        (PACKED, "[console_scripts]\nvecenv = vecenv.gone:main\n", "names the module of vecenv.gone:main"),
    ],
)
def test_a_wheel_with_a_fault_is_refused(
    tmp_path: Path, scripts: dict[str, ModuleType], names: list[str], commands: str, message: str
) -> None:
    wheel = write_wheel(tmp_path / "w.whl", names, commands)
    with pytest.raises(scripts["dist"].DistError, match=re.escape(message)):
        scripts["dist"].check_wheel(wheel, FILES)


def test_an_sdist_without_a_file_is_refused(tmp_path: Path, scripts: dict[str, ModuleType]) -> None:
    (tmp_path / "empty").touch()
    with tarfile.open(tmp_path / "s.tar.gz", "w:gz") as archive:
        for name in [*FILES[1:], *scripts["dist"].SDIST_EXTRA]:
            archive.add(tmp_path / "empty", f"vecenv-1/{name}")
    with pytest.raises(scripts["dist"].DistError, match=r"s\.tar\.gz: 1 files are missing: vecenv/cli\.py"):
        scripts["dist"].check_sdist(tmp_path / "s.tar.gz", FILES)


@pytest.mark.heavy
def test_wheel_and_sdist_have_what_the_repository_has(
    tmp_path: Path, repository: Path, scripts: dict[str, ModuleType]
) -> None:
    dist = scripts["dist"]
    wheel, sdist = dist.build(tmp_path, repository)
    files = dist.tracked_files(repository)
    dist.check_wheel(wheel, files)
    dist.check_sdist(sdist, files)
    with zipfile.ZipFile(wheel) as archive:
        assert set(DATA) <= set(archive.namelist())


# ---------------------------------------------------------------------------------------------------------------------
# The audit of installed packages.


def package(name: str, *, fixed: tuple[str, ...]) -> dict[str, Any]:
    advisory = {"id": "PYSEC-1", "aliases": ["CVE-1"], "fix_versions": list(fixed)}
    return {"name": name, "version": "1.0", "vulns": [advisory]}


@pytest.mark.parametrize(
    ("fixed", "accepted", "passes"),
    [
        (("1.1",), {}, False),
        ((), {}, True),
        (("1.1",), {"CVE-1": "unused code"}, True),
        (("1.1",), {"CVE-2": "another"}, False),
    ],
)
def test_a_vulnerability_fails_the_audit_if_a_release_ends_it_and_nothing_accepts_it(
    scripts: dict[str, ModuleType],
    capsys: pytest.CaptureFixture[str],
    fixed: tuple[str, ...],
    accepted: dict[str, str],
    passes: bool,
) -> None:
    assert scripts["audit"]._judge([package("web", fixed=fixed)], accepted) is passes
    assert "web 1.0: PYSEC-1" in capsys.readouterr().out


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize(
    "answer",
    ["", "Traceback\nConnectionError: no route", '{"dependencies": [{"name": "a", "skip_reason": "not found"}]}'],
)
def test_an_unreachable_database_is_said_and_fails_a_strict_audit_only(
    scripts: dict[str, ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    answer: str,
    strict: bool,
) -> None:
    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 0, answer, answer)

    monkeypatch.setattr(scripts["audit"].subprocess, "run", run)
    assert scripts["audit"].check_packages({}, strict=strict, report_only=False) is not strict
    assert "not audited: no database of advisories can be reached" in capsys.readouterr().out
