"""Options of a functional environment: one frozen dataclass, the one place of their defaults."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco

from vecenv.errors import InvalidInput
from vecenv.libero.functional.objectives import OBJECTIVES
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.render.options import COLORS, LARGEST_SIDE, POLICY_CAMERAS
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
class Randomization:
    """How much worlds differ, in physics and in images; every draw is uniform.

    As ``FunctionalConfig.randomization`` it is drawn anew at every reset; ``randomize`` draws the physics of a world
    once and for all. For physics, a quantity has a lower and an upper factor. For images it has the same name, meaning
    and unit as in ``vecenv.libero.render.options.VisualVariation``, and 0 changes nothing.

    Attributes:
        friction: sliding friction of all geoms, one factor a world.
        mass: mass and inertia of each movable object and each link of the robot, a factor each.
        damping: damping of each joint.
        armature: rotor inertia of each joint.
        frictionloss: dry friction of each joint.
        gripper: strength of the finger actuators (their stiffness and damping), one factor a world.
        light: the light's scale lies within 1 plus or minus this; at most 1.
        light_shift: largest shift of the lamps along each axis, metres.
        color: scales of red, green and blue of each instance lie within 1 plus or minus this; at most 1.
        camera_pos: largest shift of a camera along each axis of its own frame, metres.
        camera_turn: largest rotation of a camera about each of these axes, radians; at most pi.
        cameras: the cameras that move, some of ``"agentview"`` and ``"wrist"``.
    """

    friction: tuple[float, float] = (0.7, 1.3)
    mass: tuple[float, float] = (0.8, 1.2)
    damping: tuple[float, float] = (0.7, 1.3)
    armature: tuple[float, float] = (0.95, 1.05)
    frictionloss: tuple[float, float] = (0.7, 1.3)
    gripper: tuple[float, float] = (0.8, 1.2)
    light: float = 0.0
    light_shift: float = 0.0
    color: float = 0.0
    camera_pos: float = 0.0
    camera_turn: float = 0.0
    cameras: Sequence[str] = ("agentview",)

    def __post_init__(self) -> None:
        for name in FACTORS:
            match getattr(self, name):
                case (float() | int() as low, float() | int() as high) if 0 < low <= high < math.inf:
                    pass
                case wrong:
                    raise FunctionalError(f"{name}={wrong}: expected 0 < lower <= upper factor")
        for name, most in SPREADS.items():
            match getattr(self, name):
                case float() | int() as spread if 0 <= spread <= most and spread < math.inf:
                    pass
                case wrong:
                    bound = "a finite number of at least 0" if most == math.inf else f"a number from 0 to {most:.4g}"
                    raise FunctionalError(f"{name}={wrong}: expected {bound}")
        known = not isinstance(self.cameras, str) and set(self.cameras) <= set(POLICY_CAMERAS)
        moves = self.camera_pos > 0 or self.camera_turn > 0
        if not known or (moves and not self.cameras):
            raise FunctionalError(f"cameras={self.cameras!r}: expected some of {', '.join(POLICY_CAMERAS)}")

    @property
    def visual(self) -> tuple[str, ...]:
        """Names of the quantities that change images, those that are not 0."""
        return tuple(name for name in SPREADS if getattr(self, name) > 0)


# Quantities of Randomization: factors of physics; and of images, the largest value that each may have.
FACTORS = ("friction", "mass", "damping", "armature", "frictionloss", "gripper")
SPREADS = {"light": 1.0, "light_shift": math.inf, "color": 1.0, "camera_pos": math.inf, "camera_turn": math.pi}


@dataclass(frozen=True, kw_only=True)
class FunctionalConfig:
    """Options of a functional environment.

    Attributes:
        impl: ``"warp"``, ``"jax"``, or None: warp where JAX runs on CUDA and jax elsewhere.
        geometry: ``"exact"``, upstream's collision geoms, or ``"lean"``, at most 24 fitted ones.
        contacts: ``"published"``, those of the MuJoCo that LIBERO comes from, or ``"current"``.
        deterministic: with ``impl="warp"``, results that do not depend on the order in which threads run
            (``vecenv.libero.physics.mjx.deterministic``); needs elliptic cones.
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
        antialias: whether edges in images are traced again with four rays a pixel, see
            ``vecenv.libero.render.options.RenderConfig``.
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
        randomization: how much physics and images differ from the published scene, drawn for each episode of each
            world from the key of its reset; None for not at all.
    """

    impl: str | None = None
    geometry: str = "exact"
    contacts: Contacts = "published"
    deterministic: bool = False
    scenes: str | None = None
    budget: Budget | None = None
    iterations: tuple[int, int] | None = None
    cone: str = "elliptic"
    action: str = "osc"
    action_scale: float = 1.0
    obs: str | Sequence[str] = ("proprio", "objects")
    image_size: int = 64
    antialias: bool = False
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
    randomization: Randomization | None = None

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
        if self.deterministic and (self.impl == "jax" or self.cone != "elliptic"):
            raise FunctionalError(
                f"deterministic=True with impl={self.impl!r} and cone={self.cone!r}: it needs 'warp' and 'elliptic'"
            )
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
        self._check_randomization()

    def _check_randomization(self) -> None:
        if self.randomization is None:
            return
        if not isinstance(self.randomization, Randomization):
            raise FunctionalError(f"randomization={self.randomization!r}: expected a Randomization, or None")
        if self.randomization.visual and PIXELS not in self.observed:
            name = self.randomization.visual[0]
            raise FunctionalError(
                f"randomization: {name}={getattr(self.randomization, name)} changes images, and obs={self.obs!r} has "
                f"none; add {PIXELS!r} to obs or set {name}=0"
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
