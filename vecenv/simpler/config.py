"""Options of a SIMPLER batch: one frozen dataclass, the only place of their defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vecenv.contract import SUCCESS_MODES
from vecenv.errors import InvalidInput
from vecenv.observations import choose_cameras
from vecenv.protocols import SIMPLER
from vecenv.protocols import protocol as find_protocol
from vecenv.simpler.control.servo import ServoConfig
from vecenv.simpler.published.lists import SEED, check_protocol
from vecenv.simpler.variants import Variant, make_variant
from vecenv.util import configs, inputs

BACKENDS = ("physx_cpu",)
# Name of the default CPU physics in all suites.
_NATIVE = "native"
_NO_CUDA = (
    "backend='physx_cuda' is not supported: SIMPLER runs on backend='physx_cpu' (the default, also called 'native'), "
    "spread over processes by num_threads. SAPIEN's GPU physics needs a PhysX library that is no part of its wheel, "
    "and vecenv's scenes, controllers and criteria have not been written or tested for it; a GPU can render the images"
)
# LIBERO's name for the third-person camera, which is the only one.
CAMERAS = ("agentview",)
GRIPPERS = ("native", "binary")
OVERLAYS = ("background", "none", "blend")


class SimplerError(InvalidInput):
    """An option or call that is not possible; the message lists valid values."""


@dataclass(frozen=True, kw_only=True)
class SimplerConfig:
    """Options of a SIMPLER batch.

    Attributes:
        backend: ``"physx_cpu"``, also called ``"native"``; ``"physx_cuda"`` is not supported and raises.
        num_threads: worker processes that scenes are spread over; 1 steps them in this process. None: one per
            core, at most one per slot.
        gripper: ``"native"``, the robot's own convention; or ``"binary"``, 1 closed and 0 open (threshold 0.5).
        max_steps: step budget in control ticks; None for that of each task.
        success: ``"first"``: an episode ends when its task is first solved; ``"final"``: at the end of its budget,
            where the verdict is read.
        servo: speeds and tolerances of ``step_ee_pose``; None for those of the suite.
        overlay: what replaces the background of images: ``"background"``, a photograph, as upstream's visual matching
            does; ``"none"``; or ``"blend"``, both at one half.
        shadows: whether lights cast shadows; upstream's do not, except at variant aggregation's cabinets, where they do
            here too.
        variant: differences from visual matching's scenes; None for none.
        protocol: which episodes there are, one of ``published.PROTOCOLS``: ``"seed"``, 50 of every task, or one of
            upstream's lists, which decide robots, scenes, images and budgets.
        cameras: the cameras that observations show; ``agentview`` is the only one.
        assets: root of the asset tree; None for where ``vecenv assets pull simpler`` puts it.
    """

    backend: str = "physx_cpu"
    num_threads: int | None = None
    gripper: str = "native"
    max_steps: int | None = None
    success: str | None = None
    servo: ServoConfig | None = None
    overlay: str = "background"
    shadows: bool = False
    variant: Variant | Mapping[str, Any] | None = None
    protocol: str = SEED
    cameras: list[str] | tuple[str, ...] | None = None
    assets: str | Path | None = None

    def __post_init__(self) -> None:
        configs.check(self, SimplerError, ranges={"num_threads": (1, 4096), "max_steps": (1, inputs.MOST_COUNT)})
        if self.backend == "physx_cuda":
            raise SimplerError(_NO_CUDA)
        if self.backend == _NATIVE:
            object.__setattr__(self, "backend", BACKENDS[0])
        for name, allowed in (
            ("backend", BACKENDS),
            ("gripper", GRIPPERS),
            ("overlay", OVERLAYS),
            ("success", SUCCESS_MODES),
        ):
            if getattr(self, name) not in (*allowed, *((None,) if name == "success" else ())):
                raise SimplerError(f"{name}={getattr(self, name)!r} is not available; available: {', '.join(allowed)}")
        if self.cameras is not None:
            object.__setattr__(self, "cameras", choose_cameras(self.cameras, CAMERAS))
        object.__setattr__(self, "variant", make_variant(self.variant))
        if check_protocol(self.protocol) != SEED and self.variant is not None:
            raise SimplerError(f"variant={self.variant}: protocol {self.protocol!r} already decides the variants")

    @property
    def success_mode(self) -> str:
        """When an episode ends: as given, or as the protocol says."""
        return self.success or find_protocol(self.protocol, SIMPLER).success
