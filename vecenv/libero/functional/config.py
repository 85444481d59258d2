"""Options of a functional environment: one frozen dataclass, the one place of their defaults."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco

from vecenv.errors import InvalidInput
from vecenv.libero.functional.objectives import OBJECTIVES
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.render.options import COLORS, LARGEST_SIDE
from vecenv.libero.scene.contacts import CONTACTS, Contacts
from vecenv.libero.scene.lean.geometry import PROFILES

# Width of an action by kind.
ACTIONS = {"osc": 7, "joint": 8}
PIXELS = "pixels"
OBSERVATIONS = ("proprio", "objects", PIXELS)
CONES = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}
REWARDS = ("sparse", "shaped")
PLACEMENTS = ("stored", "regions")


class FunctionalError(InvalidInput):
    """An option that this environment cannot honour; the message says what would be right."""


@dataclass(frozen=True, kw_only=True)
class FunctionalConfig:
    """Options of a functional environment.

    Attributes:
        impl: ``"warp"``, ``"jax"``, or None: warp where JAX runs on CUDA and jax elsewhere.
        geometry: ``"exact"``, upstream's collision geoms, or ``"lean"``, at most 24 fitted ones.
        contacts: ``"published"``, those of the MuJoCo that LIBERO comes from, or ``"current"``.
        scenes: a folder that ``vecenv compile`` wrote, in place of the installed packages.
        budget: contact and constraint memory of a world; None measures the scene once and remembers it.
        iterations: solver iterations and line-search steps a substep at most; None for those of ``vecenv.make``.
        cone: friction cones: ``"elliptic"`` as upstream; or ``"pyramidal"``, with which derivatives of ``impl="jax"``
            are finite (MJX's elliptic ones are NaN wherever nothing slips): forwards (``jax.jvp``, ``jax.jacfwd``)
            with any ``iterations``, backwards (``jax.grad``) with ``(1, n)``.
        action: ``"osc"``, seven numbers in [-1, 1] as upstream takes them (position, rotation vector, gripper: positive
            closes); or ``"joint"``, eight: by how much each joint's target leads the joint (1 is 0.05 rad), gripper.
        action_scale: factor on the arm's part of an action, in (0, 1].
        obs: what observations hold, one name or several: ``"proprio"`` and ``"objects"``, see
            ``FunctionalLibero.layout``; and ``"pixels"``, ray-traced camera images, which need ``warp`` and make
            observations dictionaries.
        image_size: height and width of the images, pixels.
        scenery: what there is to see, a file that ``vecenv.libero.render.scenery.Scenery.save`` wrote; None takes it
            from ``scenes``, which needs ``vecenv compile --images raytrace``, or compiles it from the installed
            packages.
        colors: how textures look in images: ``"published"``, as in LIBERO's demonstrations, or ``"current"``, as the
            installed MuJoCo shows them; see ``vecenv.libero.render.options.RenderConfig``. A scenery file must have the
            same.
        reward: ``"sparse"``, 1 in the step that succeeds; or ``"shaped"``, that plus the change of the objective's
            potential.
        objective: ``"goal"``, ``"reach"`` or ``"lift"``; defined in ``vecenv.libero.functional.objectives``.
        target: what to reach or lift; None for the first object the task is about.
        reach_distance: metres between the fingertips' middle and the target's box that count as reached.
        lift_height: metres above its start that the target must be lifted.
        placement: ``"stored"``, each episode begins in one of the task's settled starts, drawn at every reset; or
            ``"regions"``, fixtures and objects are also moved to places drawn from their BDDL regions.
        episodes: stored starts to draw from, for example to hold some back for evaluation; None for all 50.
        episode_length: steps after which training wrappers should end an episode; the environment itself counts none.
    """

    impl: str | None = None
    geometry: str = "exact"
    contacts: Contacts = "published"
    scenes: str | None = None
    budget: Budget | None = None
    iterations: tuple[int, int] | None = None
    cone: str = "elliptic"
    action: str = "osc"
    action_scale: float = 1.0
    obs: str | Sequence[str] = ("proprio", "objects")
    image_size: int = 64
    scenery: str | None = None
    colors: str = "published"
    reward: str = "sparse"
    objective: str = "goal"
    target: str | None = None
    reach_distance: float = 0.02
    lift_height: float = 0.05
    placement: str = "stored"
    episodes: tuple[int, ...] | None = None
    episode_length: int = 500

    def __post_init__(self) -> None:
        options = {
            "geometry": PROFILES,
            "contacts": CONTACTS,
            "cone": tuple(CONES),
            "action": tuple(ACTIONS),
            "colors": COLORS,
            "reward": REWARDS,
            "objective": OBJECTIVES,
            "placement": PLACEMENTS,
        }
        for name, allowed in options.items():
            if getattr(self, name) not in allowed:
                raise FunctionalError(f"{name}={getattr(self, name)!r}: expected one of {', '.join(allowed)}")
        for name in self.observed:
            if name not in OBSERVATIONS:
                raise FunctionalError(f"obs={name!r}: expected some of {', '.join(OBSERVATIONS)}")
        if not 1 <= self.image_size <= LARGEST_SIDE:
            raise FunctionalError(f"image_size={self.image_size}: expected 1 to {LARGEST_SIDE}")
        if not 0 < self.action_scale <= 1:
            raise FunctionalError(f"action_scale={self.action_scale}: expected more than 0 and at most 1")
        if self.iterations is not None and (len(self.iterations) != 2 or min(self.iterations) < 1):
            raise FunctionalError(f"iterations={self.iterations}: expected two numbers of at least 1")
        if self.episode_length < 1 or self.reach_distance < 0 or self.lift_height <= 0:
            raise FunctionalError(
                f"episode_length={self.episode_length}, reach_distance={self.reach_distance}, "
                f"lift_height={self.lift_height}: expected >= 1, >= 0 and > 0"
            )

    @property
    def observed(self) -> tuple[str, ...]:
        """``obs`` as a tuple.

        Raises:
            FunctionalError: it is empty.
        """
        names = (self.obs,) if isinstance(self.obs, str) else tuple(self.obs)
        if not names or len(set(names)) != len(names):
            raise FunctionalError(f"obs={self.obs!r}: expected some of {', '.join(OBSERVATIONS)}, each once")
        return names


def default_config() -> FunctionalConfig:
    """The default options."""
    return FunctionalConfig()


def overridden(config: FunctionalConfig, overrides: Mapping[str, object]) -> FunctionalConfig:
    """A copy with some options replaced.

    Raises:
        FunctionalError: an option that does not exist, or a value that is not allowed.
    """
    known = [field.name for field in dataclasses.fields(config)]
    unknown = sorted(set(overrides) - set(known))
    if unknown:
        raise FunctionalError(f"no option {unknown[0]!r}; options: {', '.join(known)}")
    return dataclasses.replace(config, **overrides)  # pyright: ignore[reportArgumentType]
