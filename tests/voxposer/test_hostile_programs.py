"""Programs that attack the sandbox, measured by another process: how each ends, and what it takes meanwhile."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from support.hostile import LIMITS, WORLDS, heavy, programs
from support.hostile.watch import watched
from support.hostile_programs import HEAVY, HOSTILE

from voxposer.sandbox.guard import Limits
from voxposer.sandbox.syntax import RULES

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads the memory of a process as Linux shows it")

# Small, so that two thousand programs take seconds; what a program may take beyond its limits is the same with any.
SMALL = Limits(steps=20_000, calls=100, memory_bytes=256 * 2**20, seconds=0.5)
# Rules of language programs, besides those of the sandbox.
OF_LMPS = {"query", "reply", "result", ""}


def test_there_are_a_thousand_attacks_and_none_twice() -> None:
    sources = [source for construct in WORLDS for source in programs(construct)]
    sources += [source for _, _, source in HOSTILE]
    assert len(sources) > 2000
    assert len(set(sources)) == len(sources)


@pytest.mark.parametrize("construct", WORLDS)
def test_an_attack_ends_in_its_error_within_the_limits(construct: str, tmp_path: Path) -> None:
    expected = programs(construct)
    assert set(expected.values()) <= {*RULES, *OF_LMPS}
    for used in watched(WORLDS[construct], list(expected), SMALL, tmp_path):
        assert not used.breach(SMALL), used
        rule, found = expected[used.source], used.ended["rule"]
        assert found == rule or (found in LIMITS and rule in LIMITS), (used.ended, used.source[:200])
        reason = used.ended["reason"]
        assert bool(reason) == bool(rule)
        assert len(reason) < 1500
        assert len(reason.splitlines()) < 2, reason
        for inside in (" at 0x", "<locals>", "<lambda>", "Traceback", ", in <module>"):
            assert inside not in reason.replace(used.source, ""), reason
    assert list(tmp_path.iterdir()) == []


@pytest.mark.heavy
@pytest.mark.parametrize("world", ["things", "robot"])
def test_programs_stay_within_the_limits_of_production(world: str, tmp_path: Path) -> None:
    sources = [*heavy(world), *(HEAVY if world == "things" else ())]
    for used in watched(world, sources, Limits(), tmp_path):
        assert not used.breach(Limits()), used
        assert used.ended["rule"] in {*LIMITS, "", "value", "call", "formats"}, used
