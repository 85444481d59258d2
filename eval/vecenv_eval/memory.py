"""How many slots run at once where nobody says: as many as the suite allows and as fit into the memory at hand.

The settings of a run and the memory that is free come in; a :class:`SlotChoice`, a number with its reason, goes out. A
batch takes a fixed amount, more for every scene, and more for every slot (:class:`Footprint`). A quarter of the memory
at hand is left alone. Verdicts do not depend on the number.

Figures are largest resident sizes, ``python benchmarks/memory.py`` on 2 cores (2 threads or processes), rounded up to
those of the largest suite. MiB, measured:

================================  ========================================================================
native, no images                 a slot 0.53 (libero_object), 1.0 (libero_spatial), 0.74 (libero_10);
                                  fixed 393, 318, 351, the last with five scenes
native, two images of 256 pixels  a slot 4.7, 4.6, 4.5; fixed with one scene 1,733, 1,889, 2,187;
                                  libero_10 with five scenes and five slots: 3,829 together
SIMPLER, no images                309 and 199 a worker process (8 slots); together 741 and 714 with 4 and
                                  12 slots (bridge), 728 and 733 (google_robot)
warp                              a world 1.9 (libero_object), 3.9 (libero_spatial): docs/mjx.md
================================  ========================================================================

Not measured: SIMPLER's images, which are taken to need as much as LIBERO's, and ``backend="jax"``, which is taken to
need what warp needs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vecenv import family, protocols
from vecenv.libero.config import LiberoConfig
from vecenv.util.cores import usable_cores
from vecenv_eval.config import EvalConfig
from vecenv_eval.environments import make_arguments
from vecenv_eval.episodes import MAX_SCENES, Suite
from vecenv_eval.simulator import Simulator

MIB = 2**20
# Share of the memory at hand that a batch may take: what policies and recordings allocate later is not known.
SHARE = 0.75
# Built-in policies that never read an image; of any other policy it is not known, so it is taken to.
BLIND = frozenset({"pick_place", "random", "simpler_scripted", "voxposer", "zero"})
# Side of the images that the figures were measured with, pixels.
MEASURED_SIDE = 256
CGROUPS = Path("/sys/fs/cgroup")


@dataclass(frozen=True, kw_only=True)
class Footprint:
    """Memory of a batch, MiB.

    Attributes:
        fixed: of a batch of any size.
        scene: of every scene that runs side by side.
        slot: of every slot.
    """

    fixed: float
    scene: float
    slot: float

    def slots_in(self, available: float, scenes: int) -> int:
        """How many slots fit into ``available`` MiB beside the margin; 0 where not even one does."""
        return max(0, int((available * SHARE - self.fixed - self.scene * scenes) / self.slot))


@dataclass(frozen=True)
class SlotChoice:
    """How many slots run at once, and why so many."""

    num_envs: int
    reason: str


DEVICE_BACKENDS = ("warp", "jax", "mjx")
NATIVE = Footprint(fixed=400, scene=0, slot=1.0)
# 1,800 measured, and the 256 of ``vecenv.libero.render.composite.LAYER_MEMORY``, which it was measured without.
NATIVE_IMAGES = Footprint(fixed=2056, scene=450, slot=5.0)
SIMPLER = Footprint(fixed=320, scene=0, slot=1.0)
# What a worker process of SIMPLER takes.
PROCESS = 200
WORLDS = Footprint(fixed=0, scene=0, slot=4.0)


def choose_slots(config: EvalConfig, suite: Suite, tasks: tuple[int, ...], simulator: Simulator) -> SlotChoice:
    """The number of slots of a run: the one given, else as many as the suite allows and as fit into memory.

    Args:
        config: the settings.
        suite: the suite.
        tasks: the tasks that run, for their scenes.
        simulator: knows the options of its environments.
    """
    if config.num_envs is not None:
        return SlotChoice(config.num_envs, "given")
    scenes = min(MAX_SCENES, len({suite.scenes[task] for task in tasks}))
    on_device = device_memory() if config.backend in DEVICE_BACKENDS else None
    available = available_memory() if on_device is None else on_device
    fitting = footprint(config, simulator).slots_in(available / MIB, scenes)
    what = f"{available / 2**30:.1f} GiB of {'memory' if on_device is None else 'device memory'} available"
    if fitting >= suite.max_slots:
        return SlotChoice(suite.max_slots, f"the most of {suite.name}, with {what}")
    return SlotChoice(max(1, fitting), f"{what}, of {suite.max_slots} at most")


def footprint(config: EvalConfig, simulator: Simulator) -> Footprint:
    """What a batch of a run takes in main memory, or on the device for MJX."""
    images = draws_images(config)
    if family(config.suite) == protocols.SIMPLER:
        processes = config.num_threads or usable_cores()
        slot = NATIVE_IMAGES.slot if images else SIMPLER.slot
        return Footprint(fixed=SIMPLER.fixed + PROCESS * processes, scene=SIMPLER.scene, slot=slot)
    if config.backend in DEVICE_BACKENDS:
        return WORLDS
    if not images:
        return NATIVE
    pixels = _pixels(config, simulator) / MEASURED_SIDE**2
    drawn = NATIVE_IMAGES.slot - NATIVE.slot
    return Footprint(fixed=NATIVE_IMAGES.fixed, scene=NATIVE_IMAGES.scene, slot=NATIVE.slot + drawn * pixels)


def draws_images(config: EvalConfig) -> bool:
    """Whether cameras are drawn, as far as the settings say: for the policy, a video or a dataset."""
    return config.video != "none" or config.record_lerobot or config.policy_name not in BLIND


def _pixels(config: EvalConfig, simulator: Simulator) -> int:
    """Pixels of a camera image."""
    options = simulator.check(config.suite, make_arguments(config))
    if isinstance(options, LiberoConfig):
        render = options.rules(config.suite).render
        return render.height * render.width
    return MEASURED_SIDE**2


def available_memory(cgroups: Path = CGROUPS, process: Path = Path("/proc/self/cgroup")) -> int:
    """Bytes of main memory that this process can still take: what is free, or what its control groups leave.

    Args:
        cgroups: where control groups are mounted, version 1 or 2.
        process: the file that says in which of them the process is.
    """
    import psutil

    return min([psutil.virtual_memory().available, *_left_by_cgroups(cgroups, process)])


def _left_by_cgroups(cgroups: Path, process: Path) -> Iterator[int]:
    """Bytes that each control group of the process with a limit leaves; caches that can be dropped count as left."""
    try:
        lines = process.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        version1 = controllers == "memory"
        root = cgroups / "memory" if version1 else cgroups
        names = ("memory.limit_in_bytes", "memory.usage_in_bytes") if version1 else ("memory.max", "memory.current")
        cache = "total_inactive_file" if version1 else "inactive_file"
        group = root / path.lstrip("/")
        # A container sees its own group at the mount, whatever path the host has for it.
        for folder in (group, *(each for each in group.parents if each.is_relative_to(root))):
            with suppress(OSError, ValueError):  # no such group here, or "max": no limit
                limit, used = (int((folder / name).read_text()) for name in names)
                yield max(0, limit - used + _statistic(folder / "memory.stat", cache))


def _statistic(path: Path, name: str) -> int:
    """A number of ``memory.stat``; 0 where it has none of that name."""
    rows = dict(line.split(maxsplit=1) for line in path.read_text().splitlines())
    return int(rows.get(name, 0))


def device_memory() -> int | None:
    """Free bytes of the first device of JAX; None where the device is the CPU, or does not say."""
    import jax

    statistics = jax.devices()[0].memory_stats()
    if not statistics or "bytes_limit" not in statistics:
        return None
    return int(statistics["bytes_limit"]) - int(statistics.get("bytes_in_use", 0))
