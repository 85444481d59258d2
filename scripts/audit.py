"""Security checks: bandit over this project's code, pip-audit over the installed packages.

Exit status 1 for any finding of bandit that pyproject.toml or a ``# nosec`` comment does not explain, and for a known
vulnerability of an installed package that a newer release ends. pip-audit needs a database of advisories. Where none
can be reached this is printed, and only ``--strict`` makes it an error. Usage: python scripts/audit.py [--help]
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
CODE = ("vecenv", "voxposer", "eval")
# Databases that pip-audit knows, in the order they are tried; a mirror of PyPI has packages, but often no advisories.
SERVICES = ("pypi", "osv")
# A dependency of vecenv, to find out whether a database answers before it is asked about every package.
PROBE = "packaging"
TIMEOUT_S = "10"


class Unreachable(Exception):
    """A database of advisories gave no answer; the message says why."""


def check_code() -> bool:
    """Run bandit over the packages; whether it found nothing."""
    print(f"==> bandit {' '.join(CODE)}", flush=True)
    command = [sys.executable, "-m", "bandit", "--quiet", "--configfile", "pyproject.toml", "--recursive", *CODE]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if done.returncode:
        print(done.stdout + done.stderr)
    return not done.returncode


def check_packages(accepted: dict[str, str], *, strict: bool, report_only: bool) -> bool:
    """Ask a database for vulnerabilities of the installed packages; whether the check passes.

    Args:
        accepted: identifiers of advisories that count as nothing, with the reasons.
        strict: an unreachable database is a failure.
        report_only: vulnerabilities are printed and are no failure.
    """
    print("==> pip-audit of the installed packages", flush=True)
    causes = []
    for service in SERVICES:
        try:
            with tempfile.TemporaryDirectory() as folder:
                probe = Path(folder) / "requirements.txt"
                probe.write_text(f"{PROBE}=={importlib.metadata.version(PROBE)}\n")
                _ask(service, "--requirement", str(probe), "--no-deps", "--disable-pip")
            rows = _ask(service, "--skip-editable")
        except Unreachable as cause:
            causes.append(f"{service}: {cause}")
            continue
        return _judge(rows, accepted) or report_only
    print(f"not audited: no database of advisories can be reached ({'; '.join(causes)})")
    return not strict


def _ask(service: str, *arguments: str) -> list[dict[str, Any]]:
    """What pip-audit says about packages, those left out that it could not look up.

    Raises:
        Unreachable: it could look up none.
    """
    command = [sys.executable, "-m", "pip_audit", "--vulnerability-service", service, "--timeout", TIMEOUT_S]
    command += ["--format", "json", "--progress-spinner", "off", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        rows = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError, TypeError):
        raise Unreachable((done.stderr.strip().splitlines() or ["no answer"])[-1][:200]) from None
    found = [row for row in rows if "skip_reason" not in row]
    if not found:
        raise Unreachable(f"it knows none of {len(rows)} packages")
    if len(found) < len(rows):
        print(f"not audited: {', '.join(row['name'] for row in rows if 'skip_reason' in row)}")
    return found


def _judge(rows: list[dict[str, Any]], accepted: dict[str, str]) -> bool:
    """Print the vulnerabilities; whether there is none that an upgrade would end."""
    passes = True
    for row in rows:
        for advisory in row["vulns"]:
            names = {advisory["id"], *advisory.get("aliases", ())}
            reason = next((accepted[name] for name in sorted(names) if name in accepted), None)
            fixed = ", ".join(advisory.get("fix_versions", ()))
            state = f"accepted: {reason}" if reason else f"fixed in {fixed}" if fixed else "no release ends it"
            print(f"{row['name']} {row['version']}: {advisory['id']} ({state})")
            passes &= bool(reason) or not fixed
    print(f"{len(rows)} packages audited")
    return passes


def main() -> int:
    """Run both checks; the exit status."""
    parser = argparse.ArgumentParser(description="bandit over the code, pip-audit over the installed packages")
    parser.add_argument("--strict", action="store_true", help="fail where no database of advisories can be reached")
    parser.add_argument("--report-only", action="store_true", help="print vulnerabilities of packages without failing")
    options = parser.parse_args()
    tables = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    code = check_code()
    packages = check_packages(tables["vecenv"]["audit"], strict=options.strict, report_only=options.report_only)
    return 0 if code and packages else 1


if __name__ == "__main__":
    sys.exit(main())
