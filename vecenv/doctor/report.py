"""What a report holds: packages with their versions, checks with what mends them, and the machine."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any


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
