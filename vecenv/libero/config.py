"""Options of a LIBERO batch: one frozen dataclass, the one place of their defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from vecenv.contract import FIRST, SUCCESS_MODES
from vecenv.controllers import waypoint
from vecenv.errors import InvalidInput
from vecenv.libero.physics.base import SETTLE_TICKS
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.physics.build import BACKENDS
from vecenv.libero.render.options import RenderConfig
from vecenv.libero.scene.contacts import CONTACTS, Contacts
from vecenv.libero.scene.lean.geometry import PROFILES
from vecenv.protocols import DEFAULT, ResetLoop, reset_loop

MAX_STEPS = 2500


class LiberoError(InvalidInput):
    """An option or call that this environment cannot honour; the message says what would be right."""


@dataclass(frozen=True, kw_only=True)
class LiberoConfig:
    """Options of a LIBERO batch.

    Attributes:
        protocol: name of the evaluation protocol that the options come from, for the record; it decides nothing here.
        backend: ``"native"`` (MuJoCo on CPU threads, float64), ``"warp"`` (MJX on MuJoCo Warp: NVIDIA GPUs, or a CPU),
            ``"jax"`` (MJX in pure JAX: any device), or ``"mjx"`` (warp on CUDA, jax elsewhere).
        geometry: ``"exact"``, upstream's collision geoms, or ``"lean"``, fitted ones
        (``vecenv.libero.scene.lean.geometry``).
        contacts: ``"published"``, those of the MuJoCo that LIBERO's data and checkpoints come from, or ``"current"``,
            those of the installed one (``vecenv.libero.scene.contacts``).
        budget: contact and constraint memory on MJX; None measures the scene once and remembers it.
        fixtures: ``"center"`` (of the BDDL region), ``"sampled"`` (per episode), ``"upstream"`` (as upstream draws them
            in ``reset_loop``), or name -> (pos [3] or [B, 3] in metres, quat wxyz [4] or [B, 4]), world frame.
        start: ``"settled"``, the stored init states after ten idle ticks: under MuJoCo 3.3.0, shipped with the package,
            for fixtures at the centre; settled here, once, for fixtures elsewhere (``vecenv.libero.physics.settling``).
            Or ``"raw"``, the stored init states followed by ``settle_steps``.
        settle_steps: for ``start="raw"``: control ticks with no motion and an opening gripper before an episode begins;
            they do not count.
        max_steps: step budget of an episode in control ticks.
        success: ``"first"``: an episode ends when its goal first holds; ``"final"``: at the end of its budget, where
            the verdict is read.
        seed: what ``fixtures="sampled"`` depends on, together with suite, task and episode; and for ``"upstream"``,
            what an evaluation script gives to ``env.seed``.
        reset_loop: how that script seeds and resets, for ``fixtures="upstream"``; also a mapping of its fields.
        num_threads: threads of the native backend; None for one a core.
        num_devices: GPUs (or other devices) that MJX spreads the slots over.
        render: size of camera images, level of detail, cameras of one's own.
        waypoint: tolerances and speeds of ``step_ee_pose``.
    """

    protocol: str = DEFAULT
    backend: str = "native"
    geometry: str = "exact"
    contacts: Contacts = "published"
    budget: Budget | None = None
    fixtures: str | Mapping[str, Any] = "center"
    start: str = "settled"
    settle_steps: int = SETTLE_TICKS
    max_steps: int = MAX_STEPS
    success: str = FIRST
    seed: int = 0
    reset_loop: ResetLoop | Mapping[str, Any] = field(default_factory=ResetLoop)
    num_threads: int | None = None
    num_devices: int = 1
    render: RenderConfig = field(default_factory=RenderConfig)
    waypoint: waypoint.WaypointConfig = field(default_factory=waypoint.WaypointConfig)

    def __post_init__(self) -> None:
        for name, allowed in (
            ("backend", BACKENDS),
            ("geometry", PROFILES),
            ("contacts", CONTACTS),
            ("start", ("settled", "raw")),
            ("success", SUCCESS_MODES),
        ):
            if getattr(self, name) not in allowed:
                raise LiberoError(f"{name}={getattr(self, name)!r} is not available; available: {', '.join(allowed)}")
        object.__setattr__(self, "reset_loop", reset_loop(self.reset_loop))
        if self.fixtures == "upstream":
            self.loop.at(self.seed, 0, 0)  # a seed that upstream does not take is refused before anything is built
        if self.settle_steps < 0 or self.max_steps < 1:
            raise LiberoError(f"settle_steps={self.settle_steps}, max_steps={self.max_steps}: need >= 0 and >= 1")
        if self.num_threads is not None and self.num_threads < 1:
            raise LiberoError(f"num_threads={self.num_threads}: need at least 1, or None for one a core")

    @property
    def loop(self) -> ResetLoop:
        """``reset_loop`` as what it became."""
        assert isinstance(self.reset_loop, ResetLoop)
        return self.reset_loop
