"""The report of ``vecenv doctor``: what this machine has, what is missing, and the command that installs it.

``diagnose`` returns a :class:`Report`, ``print_report`` prints it. Package versions are read from installed metadata
without importing the packages (``installed``); everything that can crash or hang a process (GL contexts, the Vulkan
loader, accelerator drivers) is probed in a child process with a time limit (``probes``); ``files`` looks for asset
trees and for the package ``libero``.
"""

from __future__ import annotations

from vecenv.doctor import files, installed, probes
from vecenv.doctor.installed import installed_version, machine, packages, versions
from vecenv.doctor.printing import print_report
from vecenv.doctor.probes import RunProbe, run_python
from vecenv.doctor.report import Check, Package, Report

__all__ = [
    "Check",
    "Package",
    "Report",
    "diagnose",
    "installed_version",
    "machine",
    "packages",
    "print_report",
    "run_python",
    "versions",
]


def diagnose(run_probe: RunProbe | None = None) -> Report:
    """Probe everything.

    Args:
        run_probe: ``(source, **environment) -> (ok, text)``, replaces :func:`run_python`; tests pass their own.
    """
    run_probe = run_probe or run_python
    rows = packages()
    checks = [
        installed.python_check(),
        *installed.package_checks(rows),
        probes.jax_check(run_probe),
        *probes.gl_checks(run_probe),
        probes.icd_check(),
        probes.vulkan_check(run_probe),
        *probes.sapien_checks(run_probe),
        *files.asset_checks(),
    ]
    return Report(rows, tuple(checks), machine())
