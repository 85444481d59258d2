"""Options of a LIBERO batch: one frozen dataclass, the only place of their defaults.

In: options by name, some of them left to the evaluation protocol. Out: ``EpisodeRules``, in which none is left open.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vecenv.contract import SUCCESS_MODES
from vecenv.controllers import waypoint
from vecenv.errors import InvalidInput
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.physics.build import BACKENDS
from vecenv.libero.render.options import RenderConfig
from vecenv.libero.scene.contacts import CONTACTS, Contacts
from vecenv.libero.scene.lean.geometry import PROFILES
from vecenv.protocols import DEFAULT, LIBERO, ResetLoop, protocol, reset_loop
from vecenv.util import configs, inputs


class LiberoError(InvalidInput):
    """An option or call that this environment cannot honour; the message says what would be right."""


ARRAYS = ("numpy", "jax")
# The least and the largest value of counts, and of the seed.
_RANGES = {
    "settle_steps": (0, inputs.MOST_COUNT),
    "max_steps": (1, inputs.MOST_COUNT),
    "num_threads": (1, 4096),
    "num_devices": (1, 4096),
    "seed": (0, 2**64 - 1),
}
# Options that have no default of their own.
_DECIDED_BY_PROTOCOL = ("start", "success")


@dataclass(frozen=True, kw_only=True)
class EpisodeRules:
    """How episodes begin and end, with nothing left open; the attributes are those of ``LiberoConfig``."""

    max_steps: int
    success: str
    seed: int
    fixtures: str | Mapping[str, Any]
    reset_loop: ResetLoop
    start: str
    settle_steps: int
    render: RenderConfig


@dataclass(frozen=True, kw_only=True)
class LiberoConfig:
    """Options of a LIBERO batch; ``vecenv.make`` takes each of them by name.

    Where the default is None, the protocol decides; ``rules`` has what it decided.

    Attributes:
        protocol: evaluation protocol that decides what is not given: ``max_steps``, ``success``, ``seed``,
            ``fixtures``, ``reset_loop``, ``start``, ``settle_steps``, episodes and the size of images. One of
            ``vecenv.protocols``; ``"seed"`` is this project's own, 2,500 ticks from settled starts.
        backend: ``"native"`` (MuJoCo on CPU threads, float64), ``"warp"`` (MJX on MuJoCo Warp: NVIDIA GPUs, or a CPU),
            ``"jax"`` (MJX in pure JAX: any device), or ``"mjx"`` (warp on CUDA, jax elsewhere).
        geometry: ``"exact"``, upstream's collision geoms, or ``"lean"``, at most 24 fitted ones a scene
            (``vecenv.libero.scene.lean.geometry``).
        contacts: ``"published"``, those of MuJoCo 2.3 to 3.3, under which LIBERO's data and checkpoints were made and
            scored, or ``"current"``, those of the installed MuJoCo (``vecenv.libero.scene.contacts``).
        deterministic: with ``backend="warp"``, bit-identical results whenever the same episodes are run with the same
            actions on the same kind of GPU, in any slots of a batch (``vecenv.libero.physics.mjx.deterministic``);
            without it two runs differ by rounding, which contacts enlarge. Native results are always the same, so
            there it changes nothing; ``"jax"`` does not have it.
        budget: contact and constraint memory on MJX; None measures each scene once and remembers it.
        fixtures: where fixtures stand, which init states do not say: ``"center"`` of their BDDL region, ``"sampled"``
            from it (a function of seed, suite, task and episode), ``"upstream"``, as upstream draws them in
            ``reset_loop``, or name -> (pos [3] or [B, 3] in metres, quat wxyz [4] or [B, 4]), world frame.
        start: ``"settled"``, the stored init states after ten idle ticks: under MuJoCo 3.3.0, shipped with the package,
            for fixtures at the centre; settled here, once, for fixtures elsewhere (``vecenv.libero.physics.settling``).
            Or ``"raw"``, the stored init states followed by ``settle_steps``.
        settle_steps: for ``start="raw"``: control ticks with no motion and an opening gripper before an episode begins;
            they do not count.
        max_steps: step budget of an episode in control ticks, 20 a second.
        success: ``"first"``: an episode ends when its goal first holds; ``"final"``: at the end of its budget, where
            the verdict is read. ``evaluate`` reports both.
        seed: what ``fixtures="sampled"`` depends on, together with suite, task and episode; and for ``"upstream"``,
            what an evaluation script gives to ``env.seed``.
        reset_loop: how that script seeds and resets, for ``fixtures="upstream"``: a ``vecenv.protocols.ResetLoop`` or a
            mapping of its fields.
        num_threads: threads of the native backend; None for one a core.
        num_devices: GPUs (or other devices) that MJX spreads the slots over.
        render: size, level of detail and colors of camera images, and cameras of your own: a ``RenderConfig`` or a
            mapping of its fields. What is not given is as LIBERO was published with. Nothing is rendered that is not
            read.
        cameras: the cameras that observations show, in this order: names of the scene's cameras (``agentview``,
            ``wrist``, ``frontview``, ...) or of those that ``render`` adds; None for all of them.
        arrays: ``"numpy"``, or ``"jax"``: verdicts, proprioception, states and images are JAX arrays on the default
            device, of 32 bits unless x64 is on; images stay where rays made them. Actions and states may be given as
            JAX arrays in both cases. ``done``, ``placement`` and ``observe_objects`` are NumPy's in both.
        scenes: a folder that ``vecenv compile`` wrote: tasks, starts and compiled scenes come from there, and with
            ``vecenv compile --images`` what images show, so that no LIBERO or robosuite files are needed. None for the
            installed packages.
        waypoint: tolerances and speeds of ``step_ee_pose`` and ``step_waypoints``; also a mapping of its fields.
    """

    protocol: str = DEFAULT
    backend: str = "native"
    geometry: str = "exact"
    contacts: Contacts = "published"
    deterministic: bool = False
    budget: Budget | None = None
    fixtures: str | Mapping[str, Any] | None = None
    start: str | None = None
    settle_steps: int | None = None
    max_steps: int | None = None
    success: str | None = None
    seed: int | None = None
    reset_loop: ResetLoop | Mapping[str, Any] | None = None
    num_threads: int | None = None
    num_devices: int = 1
    render: Mapping[str, Any] | RenderConfig | None = None
    cameras: list[str] | tuple[str, ...] | None = None
    arrays: str = "numpy"
    scenes: str | Path | None = None
    waypoint: waypoint.WaypointConfig = field(default_factory=waypoint.WaypointConfig)

    def __post_init__(self) -> None:
        configs.check(self, LiberoError, ranges=_RANGES)
        protocol(self.protocol, LIBERO)
        for name, allowed in (
            ("backend", BACKENDS),
            ("geometry", PROFILES),
            ("contacts", CONTACTS),
            ("arrays", ARRAYS),
            ("start", ("settled", "raw")),
            ("success", SUCCESS_MODES),
        ):
            value = getattr(self, name)
            if value not in allowed and not (value is None and name in _DECIDED_BY_PROTOCOL):
                raise LiberoError(f"{name}={value!r} is not available; available: {', '.join(allowed)}")
        if self.deterministic and self.backend == "jax":
            raise LiberoError("deterministic=True is for backend='warp', and 'native' has it anyway; 'jax' does not")
        if self.reset_loop is not None:
            object.__setattr__(self, "reset_loop", reset_loop(self.reset_loop))
        if isinstance(self.render, Mapping):
            configs.build(RenderConfig, self.render, what="render", error=LiberoError)
        if self.backend == "native" and self.num_devices != 1:
            raise LiberoError(
                f"num_devices={self.num_devices}: for the backends of MJX; 'native' runs on CPU threads, num_threads"
            )

    def rules(self, suite: str) -> EpisodeRules:
        """What is given here, and for the rest what the protocol says of a suite.

        Raises:
            ProtocolError: the protocol says nothing about the suite, or upstream does not take the seed.
        """
        chosen = protocol(self.protocol, LIBERO)
        decided = chosen.options(suite)
        given = {name: getattr(self, name) for name in decided}
        values = {name: decided[name] if value is None else value for name, value in given.items()}
        rules = EpisodeRules(**values, render=self._render(chosen.image_size))
        if rules.fixtures == "upstream":
            rules.reset_loop.at(
                rules.seed, 0, 0
            )  # a seed that upstream does not take is refused before anything is built
        return rules

    def _render(self, size: int | None) -> RenderConfig:
        if isinstance(self.render, RenderConfig):
            return self.render
        usual = {} if size is None else {"height": size, "width": size}
        return configs.build(RenderConfig, {**usual, **(self.render or {})}, what="render", error=LiberoError)
