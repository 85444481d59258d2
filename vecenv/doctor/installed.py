"""What is installed: packages with their versions, checked against what vecenv requires, and what machine it is on.

Versions are read from installed metadata; no package is imported for them.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import sys
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from vecenv.doctor.report import Check, Package
from vecenv.util.cores import usable_cores

DISTRIBUTION = "vecenv"
# Distributions shown although vecenv does not require them itself.
ALSO_SHOWN = ("jaxlib", "robosuite")
# Extras that include other extras: "all" is not shown, "dev" is shown for the packages that only it requires.
COLLECTIONS = ("all",)
LAST = "dev"


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


def _package(requirement: Requirement, group: str) -> Package:
    version = installed_version(requirement.name)
    ok = bool(version) and requirement.specifier.contains(version, prereleases=True)
    return Package(requirement.name, group, str(requirement.specifier), version, ok)


def python_check() -> Check:
    """Whether this Python is new enough."""
    ok = sys.version_info >= (3, 11)
    return Check("Python", ok, True, platform.python_version(), "" if ok else "install Python 3.11 or newer")


def package_checks(rows: tuple[Package, ...]) -> list[Check]:
    """One check for the core and one for each extra."""
    if not rows:
        return [Check("packages: core", False, True, "vecenv is not installed as a package", "pip install -e .")]
    groups = dict.fromkeys(p.group for p in rows if p.group != "also")
    return [_group_check(group, [p for p in rows if p.group == group]) for group in groups]


def _group_check(group: str, rows: list[Package]) -> Check:
    bad = [p for p in rows if not p.ok]
    core = group == "core"
    command = install_command("" if core else group)
    if not bad:
        return Check(f"packages: {group}", True, core, ", ".join(p.name for p in rows))
    return Check(f"packages: {group}", False, core, "; ".join(map(_complaint, bad)), command)


def install_command(extra: str = "") -> str:
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
