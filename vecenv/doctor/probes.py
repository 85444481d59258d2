"""Probes of devices and drivers, and what they say: JAX, GL, Vulkan, SAPIEN.

Each runs a few lines of Python in a process of its own with a time limit, because drivers can crash and hang. A check
takes the function that runs them (:func:`run_python`, or a test's) and returns what was found.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from vecenv.doctor.installed import install_command, installed_version
from vecenv.doctor.report import Check
from vecenv.util.cores import usable_cores

# Source of a probe and its environment variables -> whether it ran through, and what it printed.
RunProbe: TypeAlias = Callable[..., tuple[bool, str]]
# Installs the system libraries, from a clone.
SYSTEM_COMMAND = "make system"
# Where the Vulkan loader looks for drivers, unless one of these variables names files.
ICD_FOLDERS = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")
ICD_VARIABLES = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES")
PROBE_SECONDS = 60

JAX_PROBE = """
import jax
print("; ".join(f"{d.platform}:{d.id} {d.device_kind}" for d in jax.devices()))
"""

GL_PROBE = """
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
VULKAN_PROBE = """
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

SAPIEN_PROBE = """
import sapien
sapien.render.RenderMaterial()
print(f"SAPIEN {sapien.__version__} finds a device to render with")
"""

_MESA_FIX = (
    f"{SYSTEM_COMMAND}, or apt-get install libvulkan1 mesa-vulkan-drivers (24.3 or newer: bookworm-backports), "
    "or your GPU's driver"
)


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


def _cause(stderr: str) -> str:
    """The line of a traceback that names the error: the last one of the form ``SomethingError: why``."""
    lines = [line.strip() for line in stderr.strip().splitlines() if line.strip()]
    named = [line for line in lines if line.split(":")[0].split(".")[-1].endswith(("Error", "Exception"))]
    return (named or lines or [""])[-1]


def jax_check(run_probe: RunProbe) -> Check:
    """JAX, which the core computes with, and its devices."""
    ok, text = run_probe(JAX_PROBE)
    detail = f"{text}; {usable_cores()} usable cores" if ok else text
    return Check("JAX devices", ok, True, detail, "" if ok else install_command())


def gl_checks(run_probe: RunProbe) -> list[Check]:
    """EGL and OSMesa: either renders the cameras, neither is needed for physics."""
    debian = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
    checks = []
    for backend, wanted in debian.items():
        ok, text = run_probe(GL_PROBE, MUJOCO_GL=backend, PYOPENGL_PLATFORM=backend)
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


def icd_check() -> Check:
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


def vulkan_check(run_probe: RunProbe) -> Check:
    """Vulkan: SAPIEN renders with it. It finds no device in Mesa's software driver before 24.3 (measured with 22.3)."""
    ok, text = run_probe(VULKAN_PROBE)
    devices = text.splitlines()
    if ok and all(map(_mesa_too_old, devices)):
        ok, devices = False, [f"{device}: too old, SAPIEN sees no device before Mesa 24.3" for device in devices]
    return Check("Vulkan", ok, False, "; ".join(devices), "" if ok else _MESA_FIX)


def _mesa_too_old(device: str) -> bool:
    """Whether a line of the Vulkan probe names Mesa's software driver in a version below 24.3."""
    version = re.search(r"Mesa (\d+)\.(\d+)", device)
    return "llvmpipe" in device and version is not None and (int(version[1]), int(version[2])) < (24, 3)


def sapien_checks(run_probe: RunProbe, python: tuple[int, ...] = sys.version_info[:2]) -> list[Check]:
    """Whether SAPIEN, if installed, finds a device to render with; its physics needs none.

    Where it has no wheels, the extra leaves it out, and no row of packages would say that SIMPLER does not run.
    """
    if not installed_version("sapien"):
        missing = f"none for Python {'.'.join(map(str, python))}"
        return [Check("SAPIEN wheels", False, False, missing, "Python 3.11 or 3.12")] if python > (3, 12) else []
    ok, text = run_probe(SAPIEN_PROBE)
    fix = "" if ok else "a Vulkan driver, see the row above; SIMPLER works without images"
    return [Check("SAPIEN images", ok, False, text.splitlines()[-1] if text else "", fix)]
