"""How many slots run at once: what is asked for, what the suite allows, what fits; never none."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
from support.fakes import SUITE, FakeWorld
from vecenv_eval import memory
from vecenv_eval.config import EvalConfig
from vecenv_eval.memory import MIB, Footprint, available_memory, choose_slots, draws_images, footprint
from vecenv_eval.results import begin
from vecenv_eval.runner import evaluate
from vecenv_eval.simulator import describe_suite, vecenv_simulator

GIB = 2**30


def chosen(
    monkeypatch: pytest.MonkeyPatch, gib: float, suite: str = "libero_object", first: int = 3, **settings: Any
) -> int:
    """The number of slots for the first tasks of a suite, with so much memory."""
    monkeypatch.setattr(memory, "available_memory", lambda: int(gib * GIB))
    config = EvalConfig(**{"suite": suite, "policy": "zero", **settings})
    return choose_slots(config, describe_suite(suite), tuple(range(first)), vecenv_simulator()).num_envs


def test_with_much_memory_the_suite_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen(monkeypatch, 1000) == 256
    assert chosen(monkeypatch, 1000, policy="openpi") == 256
    assert chosen(monkeypatch, 1000, "simpler/bridge", policy="simpler_scripted") == 50


def test_with_less_there_are_fewer_slots_and_never_none(monkeypatch: pytest.MonkeyPatch) -> None:
    some = chosen(monkeypatch, 0.6)
    assert 1 < some < 256
    assert chosen(monkeypatch, 0.55) < some
    assert chosen(monkeypatch, 0.001) == chosen(monkeypatch, 0) == 1


def test_a_given_number_wins(monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen(monkeypatch, 0.001, num_envs=99) == 99
    assert chosen(monkeypatch, 1000, num_envs=1) == 1


@pytest.mark.parametrize("settings", [{"policy": "openpi"}, {"video": "all"}, {"record_lerobot": True}])
def test_whoever_looks_at_images_gets_fewer_slots(monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any]) -> None:
    assert draws_images(EvalConfig(suite="libero_object", **settings))
    assert not draws_images(EvalConfig(suite="libero_object", policy="zero"))
    assert chosen(monkeypatch, 5, **settings) < chosen(monkeypatch, 5)
    assert chosen(monkeypatch, 5, image_size=512, **settings) < chosen(monkeypatch, 5, **settings)


def test_scenes_that_are_drawn_side_by_side_take_memory_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    one = chosen(monkeypatch, 5.5, "libero_10", first=1, policy="openpi")
    assert chosen(monkeypatch, 5.5, "libero_10", first=10, policy="openpi") < one


def test_worker_processes_of_simpler_take_memory_of_their_own() -> None:
    one, four = (
        footprint(EvalConfig(suite="simpler/bridge", num_threads=count), vecenv_simulator()) for count in (1, 4)
    )
    assert four.fixed > one.fixed
    assert four.slot == one.slot


@pytest.mark.parametrize("backend", ["warp", "jax", "mjx"])
def test_on_a_gpu_its_free_memory_counts(monkeypatch: pytest.MonkeyPatch, backend: str) -> None:
    statistics = {"bytes_limit": 10 * GIB, "bytes_in_use": 10 * GIB - 200 * MIB}
    monkeypatch.setattr("jax.devices", lambda: [SimpleNamespace(memory_stats=lambda: statistics)])
    assert 1 < chosen(monkeypatch, 1000, backend=backend) < 256
    statistics["bytes_in_use"] = 0
    assert chosen(monkeypatch, 0, backend=backend) == 256


def test_a_cpu_of_jax_has_no_memory_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jax.devices", lambda: [SimpleNamespace(memory_stats=lambda: None)])
    assert chosen(monkeypatch, 0, backend="jax") == 1


def test_slots_fill_what_is_left_beside_the_margin() -> None:
    made = Footprint(fixed=100, scene=50, slot=10)
    assert made.slots_in(1000, 2) == int((1000 * memory.SHARE - 200) / 10)
    assert made.slots_in(100, 0) == 0


# -- control groups ----------------------------------------------------------------------------------------------------


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with 64 GiB free."""
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=64 * GIB))


def group(folder: Path, limit: str, used: int, cache: int, *, version: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    limits, usage = (
        ("memory.max", "memory.current")
        if version == 2
        else (
            "memory.limit_in_bytes",
            "memory.usage_in_bytes",
        )
    )
    (folder / limits).write_text(f"{limit}\n")
    (folder / usage).write_text(f"{used}\n")
    name = "inactive_file" if version == 2 else "total_inactive_file"
    (folder / "memory.stat").write_text(f"anon 1\n{name} {cache}\n")


@pytest.mark.usefixtures("machine")
@pytest.mark.parametrize("version", [1, 2])
def test_a_limit_of_the_control_group_counts_without_caches(tmp_path: Path, version: int) -> None:
    process = tmp_path / "cgroup"
    process.write_text("0::/a/b\n" if version == 2 else "4:memory:/a/b\n3:cpuset:/c\n0::/\n")
    root = tmp_path / "fs" if version == 2 else tmp_path / "fs" / "memory"
    group(root / "a" / "b", str(8 * GIB), 3 * GIB, GIB, version=version)
    assert available_memory(tmp_path / "fs", process) == 6 * GIB


@pytest.mark.usefixtures("machine")
def test_limits_of_the_groups_above_count_as_well(tmp_path: Path) -> None:
    process = tmp_path / "cgroup"
    process.write_text("0::/pod/container\n")
    group(tmp_path / "fs" / "pod" / "container", "max", 3 * GIB, 0, version=2)
    group(tmp_path / "fs" / "pod", str(5 * GIB), 3 * GIB, 0, version=2)
    assert available_memory(tmp_path / "fs", process) == 2 * GIB


@pytest.mark.usefixtures("machine")
def test_a_container_finds_its_limit_at_the_mount(tmp_path: Path) -> None:
    process = tmp_path / "cgroup"
    process.write_text("0::/kubepods/of/the/host\n")
    group(tmp_path / "fs", str(4 * GIB), GIB, 0, version=2)
    assert available_memory(tmp_path / "fs", process) == 3 * GIB


@pytest.mark.usefixtures("machine")
@pytest.mark.parametrize("used", [0, 9 * GIB])
def test_without_a_limit_or_beyond_it(tmp_path: Path, used: int) -> None:
    process = tmp_path / "cgroup"
    assert available_memory(tmp_path, process) == 64 * GIB  # no such file: not Linux
    process.write_text("0::/\n")
    group(tmp_path / "fs", "max", used, 0, version=2)
    assert available_memory(tmp_path / "fs", process) == 64 * GIB
    group(tmp_path / "fs", str(8 * GIB), used, 0, version=2)
    assert available_memory(tmp_path / "fs", process) == (8 * GIB if not used else 0)


# -- runs --------------------------------------------------------------------------------------------------------------


def test_verdicts_do_not_depend_on_it_and_the_folder_says_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for number, gib in enumerate((0.001, 1000)):
        monkeypatch.setattr(memory, "available_memory", lambda gib=gib: int(gib * GIB))
        config = EvalConfig(suite=SUITE, policy="random")
        store = begin(config, tmp_path / str(number))
        result = evaluate(config, store, simulator=FakeWorld().simulator)
        said = store.config()["runs"][0]
        found.append(([r.verdict for r in sorted(result.records, key=lambda r: r.key)], said["num_envs"]))
        assert f"{gib:.1f} GiB of memory available" in said["num_envs_reason"]
    (few, one), (many, most) = found
    assert (one, most) == (1, 256)
    assert few == many
