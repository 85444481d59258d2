"""Published evaluation protocols as data: what an evaluation script does around a policy, with its source.

``protocol("openpi")`` has the number of ticks of an episode in each suite, how it begins, the seed and resets that
decide fixture poses, the number of episodes, what success means, and a policy's inputs and outputs. Every number was
read in the project's own file, cited by repository, path and commit. ``make(protocol=...)``, ``vecenv eval --protocol``
and ``eval_metadata`` read it from here. This module does not depend on a simulator.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any

from vecenv.contract import FINAL, FIRST
from vecenv.errors import InvalidInput

# What NumPy's legacy generator takes as a seed.
MAX_SEED = 2**32 - 1
DEFAULT = "seed"
LIBERO, SIMPLER = "libero", "simpler"
# Suites that do not have ten tasks.
_TASKS = {"libero_90": 90}


class ProtocolError(InvalidInput):
    """A protocol, or a value in one, that does not exist; the message names what does."""


@dataclass(frozen=True, kw_only=True)
class ResetLoop:
    """How an evaluation script seeds and resets upstream LIBERO environments.

    Upstream's reset draws fixture poses from NumPy's global generator, so an episode's scene depends on the last
    ``env.seed(s)`` and on the number of resets since. The defaults are the loop of OpenVLA and
    openpi: an environment a task, seeded once, then one reset an episode.

    Attributes:
        seed_per_episode, seed_per_task: what is added to the seed for each episode and task. When both are 0 the
            environment is seeded once, before the first episode; otherwise again before every reset.
        spare_resets: resets between the construction of an environment and its first seeding.
        fresh: every episode has a new environment; otherwise there is one per task.
    """

    seed_per_episode: int = 0
    seed_per_task: int = 0
    spare_resets: int = 0
    fresh: bool = False

    def __post_init__(self) -> None:
        for name in ("seed_per_episode", "seed_per_task", "spare_resets"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise ProtocolError(f"ResetLoop: {name}={value!r}: expected an integer of at least 0")
        if not isinstance(self.fresh, bool):
            raise ProtocolError(f"ResetLoop: fresh={self.fresh!r}: expected True or False")

    def at(self, seed: int, task: int, episode: int) -> ResetPoint:
        """The resets before an episode.

        Raises:
            ProtocolError: a seed that NumPy's legacy generator does not take.
        """
        if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
            raise ProtocolError(f"seed={seed!r}: upstream's generator takes integers from 0 to {MAX_SEED}")
        reseeded = bool(self.seed_per_episode or self.seed_per_task)
        before = 0 if self.fresh else episode
        return ResetPoint(
            seed=(seed + self.seed_per_task * task + self.seed_per_episode * episode) % (MAX_SEED + 1),
            unseeded=self.spare_resets + (before if reseeded else 0),
            resets=1 if reseeded else before + 1,
        )


@dataclass(frozen=True, kw_only=True)
class ResetPoint:
    """The resets of one upstream environment up to the one that an episode begins with.

    Attributes:
        seed: the last seed it was given.
        unseeded: resets between its construction and that seed.
        resets: resets since that seed, the episode's own included, at least 1.
    """

    seed: int
    unseeded: int
    resets: int


def reset_loop(given: ResetLoop | Mapping[str, Any] | None) -> ResetLoop:
    """A loop from itself, from a mapping of its fields, or the default one from None.

    Raises:
        ProtocolError: a field that a loop does not have, or something else.
    """
    if given is None or isinstance(given, ResetLoop):
        return given or ResetLoop()
    known = [field.name for field in fields(ResetLoop)]
    if not isinstance(given, Mapping):
        raise ProtocolError(f"reset_loop={given!r}: expected a ResetLoop or a mapping of {', '.join(known)}")
    unknown = [name for name in given if name not in known]
    if unknown:
        raise ProtocolError(f"reset_loop has no field {unknown[0]!r}; it has {', '.join(known)}")
    return ResetLoop(**given)


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where a protocol's numbers were read.

    Attributes:
        repository: on GitHub, ``owner/name``; "" for this project.
        paths: files in it.
        commit: abbreviated hash of the commit that was read.
        date: that commit's date.
    """

    repository: str
    paths: tuple[str, ...]
    commit: str = ""
    date: str = ""

    def __str__(self) -> str:
        where = f"{self.repository}@{self.commit} ({self.date})" if self.repository else "this project"
        return f"{where}: {', '.join(self.paths)}"


@dataclass(frozen=True, kw_only=True)
class PolicyInterface:
    """Inputs and outputs of a policy under a protocol.

    Attributes:
        cameras: cameras whose images it gets, of ``"agentview"`` and ``"wrist"``.
        image_size: side of the images it gets, pixels; None for the rendered size.
        rotation: their rotation relative to upstream's observations, degrees.
            ``Egocentric.images`` of LIBERO are already rotated by 180.
        resize: ``"pad"``: scaled to fit and padded to a square; ``"lanczos"``: through JPEG, then Lanczos; ``""``: not.
        crop: area of the centre crop, as a share of the image; 1 for none.
        state: parts of the proprioception, in order, each a key of ``STATE_PARTS``; empty for none.
        gripper_open, gripper_close: the gripper values it outputs; None for the robot's own.
        gripper_threshold: threshold between the two values; None if the value is passed on unchanged.
        replan_steps: actions executed before the next call of the policy; None if the policy decides.
    """

    cameras: tuple[str, ...] = ("agentview", "wrist")
    image_size: int | None = None
    rotation: int = 180
    resize: str = ""
    crop: float = 1.0
    state: tuple[str, ...] = ("eef_pos", "eef_axis_angle", "gripper_qpos")
    gripper_open: float | None = -1.0
    gripper_close: float | None = 1.0
    gripper_threshold: float | None = None
    replan_steps: int | None = None


STATE_PARTS: Mapping[str, int] = MappingProxyType(
    {"eef_pos": 3, "eef_axis_angle": 3, "eef_quat_xyzw": 4, "gripper_qpos": 2}
)
"""Parts of a policy's proprioception and how many numbers each has; positions in metres, angles in radians."""


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """An evaluation protocol.

    Attributes:
        name: as ``make(protocol=...)`` takes it.
        family: ``"libero"`` or ``"simpler"``.
        sources: where the numbers were read.
        horizon: suite -> control ticks a policy has, idle ticks not counted; ``"*"`` for every other suite. Empty where
            each task has its own.
        idle_steps: ticks without motion, gripper opening, before the policy acts; they do not count.
        start: ``"raw"``, the stored init states, or ``"settled"``; "" where the family has no such choice.
        fixtures: how fixture poses are decided; "" where the family has no such choice.
        seed: seed of the environment; None if each episode has its own.
        reset_loop: how the script seeds and resets the environment.
        interleaved: the seed goes up by one from task to task, and by the number of tasks from episode to episode.
        episodes: episodes per task; None if tasks differ.
        image_size: side of rendered images, pixels; None for the family's own.
        success: ``"first"``: an episode ends when its goal first holds; ``"final"``: the verdict is read at its last
            tick.
        policy: inputs and outputs of the policy.
        note: anything else to know.
    """

    name: str
    family: str = LIBERO
    sources: tuple[Source, ...]
    horizon: Mapping[str, int] = field(default_factory=dict)
    idle_steps: int = 10
    start: str = "raw"
    fixtures: str = "upstream"
    seed: int | None = 0
    reset_loop: ResetLoop = field(default_factory=lambda: ResetLoop())
    interleaved: bool = False
    episodes: int | None = 50
    image_size: int | None = 256
    success: str = FIRST
    policy: PolicyInterface = field(default_factory=PolicyInterface)
    note: str = ""

    def horizon_of(self, suite: str) -> int | None:
        """Control ticks an episode of a suite has, a LIBERO-PRO suite as the one it varies; None: each task's own.

        Raises:
            ProtocolError: the protocol says nothing about the suite.
        """
        if not self.horizon:
            return None
        for name in (suite, suite.rpartition("_")[0], "*"):
            if name in self.horizon:
                return self.horizon[name]
        raise ProtocolError(
            f"protocol {self.name!r} has no horizon for {suite}; it has one for {', '.join(self.horizon)}"
        )

    def loop_of(self, suite: str) -> ResetLoop:
        """How the script seeds and resets in a suite."""
        if not self.interleaved:
            return self.reset_loop
        return replace(self.reset_loop, seed_per_task=1, seed_per_episode=_TASKS.get(suite, 10))

    def options(self, suite: str) -> dict[str, Any]:
        """What the protocol makes of the options of ``vecenv.make`` in a suite, apart from the size of images."""
        if self.family == SIMPLER:
            return {"success": self.success}
        return {
            "max_steps": self.horizon_of(suite),
            "settle_steps": self.idle_steps,
            "start": self.start,
            "fixtures": self.fixtures,
            "seed": self.seed,
            "reset_loop": self.loop_of(suite),
            "success": self.success,
        }

    def departures(self, suite: str, options: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
        """Options that are not the protocol's: name -> (the protocol's, the one in use)."""
        ours = self.options(suite)
        return {name: (ours[name], options[name]) for name in ours if name in options and ours[name] != options[name]}

    def to_dict(self) -> dict[str, Any]:
        """Plain types, ready for JSON."""
        plain = {name: getattr(self, name) for name in (f.name for f in fields(self))}
        made = {"horizon": dict(self.horizon), "sources": [str(source) for source in self.sources]}
        return {**plain, **made, "reset_loop": asdict(self.reset_loop), "policy": asdict(self.policy)}


# Longest demonstrations of the four suites and of libero_90 have 193, 254, 270, 505 and 373 ticks.
_OPENVLA_HORIZON = {
    "libero_spatial": 220,
    "libero_object": 280,
    "libero_goal": 300,
    "libero_10": 520,
    "libero_90": 400,
}
_THROUGH_JPEG = {
    "image_size": 224,
    "resize": "lanczos",
    "crop": 0.9,
    "gripper_open": 1.0,
    "gripper_close": 0.0,
    "gripper_threshold": 0.5,
}

_LIBERO_PROTOCOLS = (
    Protocol(
        name=DEFAULT,
        sources=(Source(repository="", paths=("docs/protocols.md",)),),
        horizon={"*": 2500},
        start="settled",
        fixtures="center",
        note="This project's own: 2,500 ticks from settled starts, fixtures at the centre of their regions.",
    ),
    Protocol(
        name="openvla",
        sources=(
            Source(
                repository="openvla/openvla",
                paths=(
                    "experiments/robot/libero/run_libero_eval.py",
                    "experiments/robot/libero/libero_utils.py",
                    "experiments/robot/openvla_utils.py",
                ),
                commit="c8f03f4",
                date="2025-03-23",
            ),
        ),
        horizon=_OPENVLA_HORIZON,
        policy=PolicyInterface(cameras=("agentview",), state=(), replan_steps=1, **_THROUGH_JPEG),
        note="The script's seed 7 is the policy's; its environments are seeded with 0.",
    ),
    Protocol(
        name="openvla-oft",
        sources=(
            Source(
                repository="moojink/openvla-oft",
                paths=(
                    "experiments/robot/libero/run_libero_eval.py",
                    "experiments/robot/libero/libero_utils.py",
                    "experiments/robot/openvla_utils.py",
                ),
                commit="213c5ff",
                date="2025-04-28",
            ),
        ),
        horizon=_OPENVLA_HORIZON,
        policy=PolicyInterface(replan_steps=8, **_THROUGH_JPEG),
        note="The script's seed 7 is the policy's; its environments are seeded with 0.",
    ),
    Protocol(
        name="openpi",
        sources=(
            Source(
                repository="Physical-Intelligence/openpi",
                paths=("examples/libero/main.py",),
                commit="15a9616",
                date="2026-06-16",
            ),
        ),
        horizon=_OPENVLA_HORIZON,
        seed=7,
        policy=PolicyInterface(image_size=224, resize="pad", replan_steps=5),
    ),
    Protocol(
        name="lerobot",
        sources=(
            Source(
                repository="huggingface/lerobot",
                paths=(
                    "src/lerobot/envs/libero.py",
                    "src/lerobot/envs/configs.py",
                    "src/lerobot/configs/eval.py",
                    "src/lerobot/scripts/lerobot_eval.py",
                    "src/lerobot/processor/env_processor.py",
                    "docs/source/libero.mdx",
                ),
                commit="7427f31",
                date="2026-08-23",
            ),
        ),
        horizon={**_OPENVLA_HORIZON, "libero_spatial": 280},
        seed=1000,
        reset_loop=ResetLoop(seed_per_episode=1, spare_resets=1),
        episodes=10,
        image_size=360,
        policy=PolicyInterface(replan_steps=10),
        note="Episodes, one environment a task (eval.batch_size=1) and 10 actions a plan as in the documented run.",
    ),
    Protocol(
        name="vla-eval",
        sources=(
            Source(
                repository="allenai/vla-evaluation-harness",
                paths=("src/vla_eval/benchmarks/libero/benchmark.py", "configs/benchmarks/libero/spatial.yaml"),
                commit="e1ee9ad",
                date="2026-08-12",
            ),
        ),
        horizon=_OPENVLA_HORIZON,
        seed=7,
        policy=PolicyInterface(image_size=256, resize="pad", gripper_threshold=0.0),
        note="Wrist image and state are sent if a config enables them; model servers decide when to replan.",
    ),
    Protocol(
        name="rlinf",
        sources=(
            Source(
                repository="RLinf/RLinf",
                paths=(
                    "rlinf/envs/libero/libero_env.py",
                    "rlinf/envs/libero/utils.py",
                    "rlinf/envs/action_utils.py",
                    "evaluations/libero/libero_{spatial,object,10}_openpi_pi05_eval.yaml",
                    "evaluations/libero/libero_goal_openpi_eval.yaml",
                    "examples/embodiment/config/env/libero_90.yaml",
                    "docs/source-en/rst_source/evaluations/guides/libero.rst",
                ),
                commit="a3816b5",
                date="2026-08-22",
            ),
        ),
        horizon={
            "libero_spatial": 240,
            "libero_object": 280,
            "libero_goal": 320,
            "libero_10": 520,
            "libero_90": 512,
        },
        idle_steps=15,
        reset_loop=ResetLoop(fresh=True),
        interleaved=True,
        policy=PolicyInterface(replan_steps=5),
        note=(
            "As for its openpi models, in one process with an environment an episode (total_num_envs=500). Episodes "
            "run to their horizon; the rate it reports, eval/success_once, is that of goals held at any tick."
        ),
    ),
    Protocol(
        name="torchrl",
        sources=(
            Source(
                repository="pytorch/rl",
                paths=("torchrl/envs/libs/libero.py",),
                commit="ae9719f",
                date="2026-08-22",
            ),
        ),
        horizon={"*": 512},
        fixtures="sampled",
        policy=PolicyInterface(cameras=("agentview",), state=("eef_pos", "eef_quat_xyzw", "gripper_qpos")),
        note='It names no seed, so fixtures are drawn and not replayed; init states as with init_state_mode="cycle".',
    ),
)

_SIMPLER_SCRIPTS = Source(
    repository="simpler-env/SimplerEnv",
    paths=("scripts/", "simpler_env/evaluation/maniskill2_evaluator.py"),
    commit="4ab7178",
    date="2025-03-28",
)
_SIMPLER_POLICY = PolicyInterface(
    cameras=("agentview",), rotation=0, state=(), gripper_open=None, gripper_close=None, replan_steps=1
)
_NO_CHOICE: dict[str, Any] = {
    "family": SIMPLER,
    "idle_steps": 0,
    "start": "",
    "fixtures": "",
    "seed": None,
    "image_size": None,
    "policy": _SIMPLER_POLICY,
}

_SIMPLER_PROTOCOLS = (
    Protocol(
        name=DEFAULT,
        sources=(Source(repository="", paths=("docs/simpler.md", "docs/protocols.md")),),
        note="This project's own: seeds 2022 to 2071 of every task.",
        **_NO_CHOICE,
    ),
    Protocol(
        name="visual-matching",
        sources=(_SIMPLER_SCRIPTS,),
        episodes=None,
        success=FINAL,
        note="A policy of upstream's may also end an episode itself; here all run to their horizon.",
        **_NO_CHOICE,
    ),
    Protocol(
        name="variant-aggregation",
        sources=(_SIMPLER_SCRIPTS,),
        episodes=None,
        success=FINAL,
        note="A policy of upstream's may also end an episode itself; here all run to their horizon.",
        **_NO_CHOICE,
    ),
)

PROTOCOLS: Mapping[str, Mapping[str, Protocol]] = MappingProxyType(
    {
        LIBERO: MappingProxyType({each.name: each for each in _LIBERO_PROTOCOLS}),
        SIMPLER: MappingProxyType({each.name: each for each in _SIMPLER_PROTOCOLS}),
    }
)
"""Every protocol, by family and name."""


def protocol(name: str, family: str = LIBERO) -> Protocol:
    """A protocol by name.

    Raises:
        ProtocolError: the family has no protocol of that name; the message lists those it has.
    """
    known = PROTOCOLS[family]
    if not isinstance(name, str) or name not in known:
        raise ProtocolError(f"protocol={name!r} is not available for {family}; available: {', '.join(known)}")
    return known[name]
