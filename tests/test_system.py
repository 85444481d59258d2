"""``make system``: what it would install on which machine; nothing here touches this one's packages."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from support.paths import REPOSITORY

SCRIPT = REPOSITORY / "scripts/system.sh"
APT = "env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends"
MIRROR = " 500 http://mirror.test/debian bookworm/main amd64 Packages"


class Machine:
    """A machine made of small programs: its libraries, its packages, who runs the script."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.log = folder, folder / "log"
        self.bin, self.icds = folder / "bin", folder / "icd.d"
        self.icds.mkdir()
        self.bin.mkdir()
        (folder / "sources").mkdir()
        for tool in ("bash", "awk", "sort", "head", "printf", "cat", "tr", "env"):
            real = next(p for p in ("/usr/bin", "/bin") if (Path(p) / tool).exists())
            (self.bin / tool).symlink_to(Path(real) / tool)
        self.has(libraries=(), installed={}, offered={}, root=True, release="bookworm")

    def has(
        self,
        *,
        libraries: tuple[str, ...],
        installed: dict[str, str],
        offered: dict[str, str],
        root: bool,
        release: str,
        policy: str = MIRROR,
    ) -> None:
        """Write the programs."""
        self._program("ldconfig", "\n".join(["cat <<'END'", *libraries, "END"]))
        cases = "".join(f"  {name}) echo 'Candidate: {version}';;\n" for name, version in offered.items())
        self._program(
            "apt-cache", f"case ${{2:-}} in\n  '') echo '{policy}';;\n{cases}  *) echo 'Candidate: (none)';;\nesac"
        )
        cases = "".join(f"  {name}) printf '%s' '{version}';;\n" for name, version in installed.items())
        self._program("dpkg-query", f"case $4 in\n{cases}  *) exit 1;;\nesac")
        self._program("apt-get", f'echo "$*" >> {self.log}')
        self._program("id", f"echo {0 if root else 1000}")
        (self.folder / "os-release").write_text(f"VERSION_CODENAME={release}\n")

    def without(self, program: str) -> None:
        """Take a program away."""
        (self.bin / program).unlink()

    def _program(self, name: str, text: str) -> None:
        path = self.bin / name
        path.write_text(f"#!{self.bin}/bash\n{text}\n")
        path.chmod(0o755)

    def run(self, mode: str) -> subprocess.CompletedProcess[str]:
        """Run the script."""
        environment = {
            "PATH": str(self.bin),
            "APT_SOURCES": str(self.folder / "sources"),
            "OS_RELEASE": str(self.folder / "os-release"),
            "VULKAN_ICDS": str(self.icds),
        }
        return subprocess.run(["bash", SCRIPT, mode], env=environment, capture_output=True, text=True, check=False)

    @property
    def calls(self) -> list[str]:
        """What apt-get was called with."""
        return self.log.read_text().splitlines() if self.log.exists() else []


OFFERED = {"mesa-vulkan-drivers": "22.3.6-1", "libosmesa6": "22.3.6-1", "libvulkan1": "1.3.239"}
ALL_LIBRARIES = ("libEGL.so.1", "libOSMesa.so.8", "libvulkan.so.1")


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_bookworm_gets_mesa_from_backports_of_its_own_mirror(machine: Machine) -> None:
    machine.has(libraries=("libEGL.so.1",), installed={}, offered=OFFERED, root=True, release="bookworm")
    done = machine.run("install")
    assert done.returncode == 0, done.stderr
    source = machine.folder / "sources/bookworm-backports.list"
    assert source.read_text() == "deb http://mirror.test/debian bookworm-backports main\n"
    assert machine.calls == [
        "update",
        "install -y --no-install-recommends libosmesa6 libvulkan1",
        "install -y --no-install-recommends -t bookworm-backports mesa-vulkan-drivers",
    ]


def test_make_test_and_make_eval_bring_what_the_release_has(machine: Machine) -> None:
    machine.has(libraries=("libEGL.so.1",), installed={}, offered=OFFERED, root=True, release="bookworm")
    done = machine.run("release")
    assert done.returncode == 0, done.stderr
    assert machine.calls == [
        "update",
        "install -y --no-install-recommends libosmesa6",
        "install -y --no-install-recommends libvulkan1",
    ]
    assert "lack system libraries: mesa-vulkan-drivers (Mesa 24.3 or newer)" in done.stdout


def test_without_root_they_only_say_what_is_missing(machine: Machine) -> None:
    machine.has(libraries=(), installed={}, offered=OFFERED, root=False, release="bookworm")
    done = machine.run("release")
    assert done.returncode == 0, done.stderr
    assert machine.calls == []
    assert "libegl1 libgl1-mesa-dri libosmesa6 libvulkan1 mesa-vulkan-drivers" in done.stdout


def test_a_dry_run_prints_the_same_commands_and_runs_none(machine: Machine) -> None:
    machine.has(libraries=("libEGL.so.1",), installed={}, offered=OFFERED, root=True, release="bookworm")
    done = machine.run("dry")
    source = machine.folder / "sources/bookworm-backports.list"
    assert done.stdout.splitlines() == [
        f"echo 'deb http://mirror.test/debian bookworm-backports main' > {source}",
        "apt-get update",
        f"{APT} libosmesa6 libvulkan1",
        f"{APT} -t bookworm-backports mesa-vulkan-drivers",
    ]
    assert machine.calls == []
    assert not source.exists()


def test_a_release_with_a_new_mesa_needs_no_backports(machine: Machine) -> None:
    offered = {**OFFERED, "mesa-vulkan-drivers": "25.0.7-2"}
    machine.has(libraries=ALL_LIBRARIES, installed={}, offered=offered, root=True, release="trixie")
    assert machine.run("dry").stdout.splitlines() == ["apt-get update", f"{APT} mesa-vulkan-drivers"]


def test_a_release_with_an_old_mesa_and_no_backports_is_reported(machine: Machine) -> None:
    machine.has(libraries=ALL_LIBRARIES, installed={}, offered=OFFERED, root=True, release="jammy")
    done = machine.run("install")
    assert "the newest mesa-vulkan-drivers here is 22.3.6-1: SIMPLER's images need 24.3" in done.stdout
    assert machine.calls == ["update"]


@pytest.mark.parametrize(("version", "enough"), [("22.3.6-1+deb12u2", False), ("24.2.8", False), ("24.3.0-1", True)])
def test_an_installed_mesa_counts_from_24_3_on(machine: Machine, version: str, enough: bool) -> None:
    installed = {"mesa-vulkan-drivers": version}
    machine.has(libraries=ALL_LIBRARIES, installed=installed, offered=OFFERED, root=True, release="bookworm")
    assert ("GL and Vulkan are there" in machine.run("install").stdout) is enough


def test_a_gpus_own_driver_suffices(machine: Machine) -> None:
    (machine.icds / "nvidia_icd.json").touch()
    machine.has(libraries=ALL_LIBRARIES, installed={}, offered=OFFERED, root=True, release="bookworm")
    assert machine.run("install").stdout == "==> GL and Vulkan are there\n"
    assert machine.run("check").stdout == ""
    assert machine.calls == []


def test_without_root_the_commands_are_named_and_nothing_runs(machine: Machine) -> None:
    machine.has(libraries=ALL_LIBRARIES, installed={}, offered=OFFERED, root=False, release="bookworm")
    done = machine.run("install")
    assert done.returncode == 1
    assert "only root can install" in done.stderr
    assert f"{APT} -t bookworm-backports mesa-vulkan-drivers" in done.stdout
    assert machine.calls == []


def test_without_apt_the_packages_are_named(machine: Machine) -> None:
    machine.without("apt-get")
    done = machine.run("install")
    assert done.returncode == 1
    for name in ("libegl1", "libgl1-mesa-dri", "libosmesa6", "libvulkan1", "mesa-vulkan-drivers (Mesa 24.3 or newer)"):
        assert name in done.stderr


def test_a_check_says_what_is_missing_and_never_fails(machine: Machine) -> None:
    done = machine.run("check")
    assert done.returncode == 0
    assert "missing system libraries for images: libegl1 libgl1-mesa-dri libosmesa6 libvulkan1" in done.stdout
    assert "make system" in done.stdout
    assert machine.calls == []


def test_a_distribution_without_osmesa_is_not_asked_for_it(machine: Machine) -> None:
    offered = {"mesa-vulkan-drivers": "25.2.8"}
    machine.has(libraries=(), installed={}, offered=offered, root=True, release="forky")
    assert f"{APT} libegl1 libgl1-mesa-dri libvulkan1 mesa-vulkan-drivers" in machine.run("dry").stdout


def test_this_machines_own_state_can_be_read() -> None:
    done = subprocess.run(["bash", SCRIPT, "check"], env=dict(os.environ), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
