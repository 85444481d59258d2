"""LIBERO tasks as Gymnasium environments: a batch behind ``gymnasium.vector``, or one episode behind ``gymnasium.Env``.

In: a batch that ``vecenv.make`` returned, on any backend, or the name of a task. Out: ``VectorEnv``, whose
sub-environments are the slots of the batch, in any of Gymnasium's three autoreset modes; and ``Env``, a batch of one.
``register_envs`` makes Gymnasium's registry know every task, without reading any::

    vecenv.interop.gymnasium.register_envs()
    envs = gymnasium.make_vec("vecenv/libero_object-0-v0", num_envs=8, max_steps=300)
    envs = VectorEnv(vecenv.make("libero_object", tasks=[0, 1], backend="warp"), autoreset_mode="SameStep")

A sub-environment keeps its task and goes through the task's episodes: it plays each once before any comes again,
beginning with the one that was placed and in the order given; once seeded, in random orders that its seed decides.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

import vecenv
from vecenv import placement
from vecenv.contract import ACTION_DIM, Control
from vecenv.errors import InvalidInput
from vecenv.libero.env import LiberoEnv
from vecenv.libero.physics.base import Group
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks.suites import NUM_EPISODES, list_suites, list_tasks

__all__ = ["Env", "GymnasiumError", "VectorEnv", "env_ids", "make_vec", "register_envs"]

OBSERVATIONS = ("proprio", "objects")
# Observations are clipped to plus and minus this (metres, radians): a bound that only broken physics reaches.
BOUND = 100.0
_PROPRIO = 8

Observation: TypeAlias = "np.ndarray | dict[str, np.ndarray]"


class GymnasiumError(InvalidInput):
    """An option that these environments do not have; the message says what would be right."""


class _Observer:
    """What is observed of a batch.

    Args:
        env: the batch.
        names: one of ``OBSERVATIONS`` for a plain array, or several for a dictionary of arrays.

    Attributes:
        space: of one slot.
        layouts: where what is in ``objects``, for each slot: name -> columns.
    """

    def __init__(self, env: LiberoEnv, names: str | Sequence[str]) -> None:
        self._env, self._plain = env, isinstance(names, str)
        self._names = (names,) if isinstance(names, str) else tuple(names)
        if not self._names or len(set(self._names)) != len(self._names) or not set(self._names) <= set(OBSERVATIONS):
            raise GymnasiumError(f"obs={names!r}: expected 'proprio', 'objects' or both; nothing renders here yet")
        layouts = [_layout(group.scene) for group in env.physics.groups]
        self._width = max(max(columns.stop for columns in layout.values()) for layout in layouts)
        self.layouts = tuple(layouts[group] for group in env.scene_index)
        widths = {"proprio": _PROPRIO, "objects": self._width}
        boxes: dict[str, spaces.Space[Any]] = {
            name: spaces.Box(-BOUND, BOUND, (widths[name],), np.float32) for name in self._names
        }
        self.space: spaces.Space = boxes[self._names[0]] if self._plain else spaces.Dict(boxes)

    def __call__(self) -> Observation:
        """The present observation of every slot."""
        found = {name: _bounded(getattr(self, f"_{name}")()) for name in self._names}
        return found[self._names[0]] if self._plain else found

    def _proprio(self) -> np.ndarray:
        return self._env.observe_egocentric().state

    def _objects(self) -> np.ndarray:
        out = np.zeros((self._env.num_envs, self._width))
        for group in self._env.physics.groups:
            group.refresh_kinematics()
            seen = _objects(group)
            out[group.slots, : seen.shape[1]] = seen
        return out


def _bounded(values: np.ndarray) -> np.ndarray:
    return np.clip(np.nan_to_num(values), -BOUND, BOUND).astype(np.float32)


def _layout(scene: Scene) -> Mapping[str, slice]:
    columns = {name: slice(7 * i, 7 * i + 7) for i, name in enumerate(scene.entities)}
    poses = 7 * len(columns)
    return {**columns, "fixture_joints": slice(poses, poses + sum(len(entity.joints) for entity in scene.fixtures))}


def _objects(group: Group) -> np.ndarray:
    """Poses of all objects and fixtures and joint positions of the fixtures, [n, width]."""
    scene, rows = group.scene, len(group.slots)
    bodies = [scene.model.body(entity.root_body).id for entity in scene.entities.values()]
    joints = [scene.model.joint(joint).qposadr[0] for entity in scene.fixtures for joint in entity.joints]
    poses = np.concatenate([group.xpos[:, bodies], group.xquat[:, bodies]], axis=2)
    return np.concatenate([poses.reshape(rows, -1), group.qpos[:, np.array(joints, int)]], axis=1)


class _Rotation:
    """Which episode of a task a slot plays next.

    Args:
        pool: the episodes.
        first: the one to begin with.
    """

    def __init__(self, pool: Sequence[int], first: int) -> None:
        start = list(pool).index(first) if first in pool else 0
        self._order, self._rng = [*pool[start:], *pool[:start]], None
        self._coming: list[int] = []

    def seed(self, rng: np.random.Generator) -> None:
        """Begin anew, in orders drawn from ``rng``."""
        self._rng, self._coming = rng, []

    def next(self) -> int:
        """The next episode."""
        if not self._coming:
            order = self._order if self._rng is None else self._rng.permutation(sorted(self._order))
            self._coming = [int(episode) for episode in order]
        return self._coming.pop(0)


class _Slots:
    """A batch whose slots begin and end episodes independently of each other.

    Args:
        env: the batch.
        episodes: those to go through, for all tasks or by task; None for those that were placed.
        obs: see ``_Observer``.
    """

    def __init__(self, env: LiberoEnv, episodes: Any, obs: str | Sequence[str]) -> None:
        self.env, self.observe = env, _Observer(env, obs)
        placed = env.placement
        self._rotations = [
            _Rotation(_pool(placed, int(task), episodes), int(first))
            for task, first in zip(placed.task, placed.episode, strict=True)
        ]

    def seed(self, slot: int, rng: np.random.Generator) -> None:
        """Let ``rng`` decide in which order a slot plays its episodes."""
        self._rotations[slot].seed(rng)

    def begin(self, mask: np.ndarray, episode: Any = None) -> dict[str, np.ndarray]:
        """Begin the next or the given episode in some slots; the others go on. Returns what there is to say of them."""
        slots = np.flatnonzero(mask)
        self.env.set_episodes(
            slots=slots, episodes=self._next(slots) if episode is None else self._given(episode)[slots]
        )
        info = self.env.reset()
        return {"episode_id": np.array(info.episode_id, object), "instruction": np.array(info.instruction, object)}

    def _next(self, slots: np.ndarray) -> list[int]:
        return [self._rotations[slot].next() for slot in slots]

    def _given(self, episode: Any) -> np.ndarray:
        counts = {"num_tasks": 1, "num_episodes": NUM_EPISODES}
        return placement.each(None, episode, self.env.placement, **counts).episode

    def step(self, actions: Any) -> tuple[Control, dict[str, np.ndarray]]:
        """One tick; finished slots ignore it. Returns what there is to say of it as well."""
        control = self.env.step_continuous(actions)
        return control, {
            "success": control.success,
            "step_index": control.step_index,
            "sanitized": control.info["sanitized"],
            "fault": np.array(control.info["fault"], object),
        }


def _pool(placed: placement.Placement, task: int, episodes: Any) -> list[int]:
    """Episodes of one task."""
    if episodes is None:
        return list(dict.fromkeys(placed.episode[placed.task == task].tolist()))
    return placement.cross(task, episodes, num_tasks=task + 1, num_episodes=NUM_EPISODES).episode.tolist()


def _check_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> Mapping[str, Any]:
    for name in options or {}:
        if name not in known:
            raise GymnasiumError(f"reset option {name!r} does not exist; options: {', '.join(known)}")
    return options or {}


class VectorEnv(gymnasium.vector.VectorEnv[Any, np.ndarray, np.ndarray]):
    """A batch of LIBERO episodes as Gymnasium's vector environment.

    Observations are float32: ``proprio`` [8], what ``observe_egocentric().state`` holds, and ``objects``, pose (xyz in
    metres, wxyz, world frame) of each object and fixture and the joints of the fixtures; see ``layouts``. With scenes
    of different size in a batch, ``objects`` is padded with zeros. Actions are those of ``step_continuous``.

    ``infos`` of a step hold ``success``, ``step_index``, ``sanitized`` and ``fault`` (as in ``contract.Control``),
    those of a beginning episode ``episode_id`` and ``instruction``, each with a mask ``_name`` of who it is about; with
    ``SAME_STEP`` also ``final_obs`` and ``final_info``.

    Args:
        env: the batch, not used by anyone else; closed with this one.
        episodes: what a slot goes through, for all tasks or a mapping task -> episodes; None for those of its task that
            the batch was made with.
        obs: ``"proprio"`` or ``"objects"`` for arrays, or several names for dictionaries.
        autoreset_mode: what happens to an episode that ended: ``NEXT_STEP``, its next step begins a new one;
            ``SAME_STEP``, a new one begins at once; ``DISABLED``, call ``reset`` with a mask.

    Raises:
        GymnasiumError, PlacementError: an observation or episode that does not exist.

    Attributes:
        batch: the batch, for its other verbs (``evaluate``, ``observe_objects``, ``state``).
        layouts: where what is in ``objects``, for each slot: name -> columns.
    """

    def __init__(
        self,
        env: LiberoEnv,
        *,
        episodes: Any = None,
        obs: str | Sequence[str] = OBSERVATIONS,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.batch, self.num_envs = env, env.num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self._slots = _Slots(env, episodes, obs)
        self.layouts = self._slots.observe.layouts
        self.single_action_space = _action_space()
        self.single_observation_space = self._slots.observe.space
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._seeded: list[tuple[np.random.Generator, int] | None] = [None] * self.num_envs
        self._begun, self._ended = np.zeros((2, self.num_envs), bool)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The random generators of the sub-environments."""
        return tuple(self._generator(slot)[0] for slot in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Their seeds."""
        return tuple(self._generator(slot)[1] for slot in range(self.num_envs))

    def _generator(self, slot: int) -> tuple[np.random.Generator, int]:
        made = self._seeded[slot] or seeding.np_random()
        self._seeded[slot] = made
        return made

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin a new episode in every sub-environment, or in some.

        Args:
            seed: what decides which episodes come, see the module; one number s for s, s + 1, ..., or one a
                sub-environment, or None to go on.
            options: ``reset_mask``, bool [B]: those to reset, the others stay as they are; ``episode``: the init state
                to begin with, one for all or [B].

        Raises:
            TypeError, ValueError: not a mask, or a wrong number of seeds.
            GymnasiumError, PlacementError: an option or episode that does not exist.
        """
        options = dict(_check_options(options, ("reset_mask", "episode")))
        mask = _reset_mask(options.get("reset_mask"), self.num_envs)
        for slot, number in enumerate(_seeds(seed, self.num_envs)):
            if number is not None and mask[slot]:
                self._seeded[slot] = seeding.np_random(number)
                self._slots.seed(slot, self._generator(slot)[0])
        said = self._slots.begin(mask, options.get("episode"))
        self._begun |= mask
        self._ended &= ~mask
        return self._observe(), _infos(said, mask)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance every sub-environment by one tick, 50 ms.

        Args:
            actions: [B, 7] in [-1, 1], see ``vecenv.contract``.

        Raises:
            ResetNeeded: before the first ``reset``, or with ``DISABLED`` when an episode has ended.
            ActionError: actions of another shape.
        """
        self._check_live()
        idle = self._ended
        control, said = self._slots.step(actions)
        terminated, truncated = control.terminated & ~idle, control.truncated & ~idle
        done = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            infos = self._restart(said, done)
        else:
            infos = _infos(said, ~idle) | (_infos(self._slots.begin(idle), idle) if idle.any() else {})
            self._ended = done
        return self._observe(), np.where(idle, 0.0, control.reward), terminated, truncated, infos

    def _check_live(self) -> None:
        if not self._begun.all():
            raise ResetNeeded("call reset() before step()")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            ended = np.flatnonzero(self._ended).tolist()
            raise ResetNeeded(f"the episodes of {ended} have ended; call reset(options={{'reset_mask': mask}})")

    def _restart(self, said: Mapping[str, np.ndarray], done: np.ndarray) -> dict[str, Any]:
        """Begin new episodes where some ended, whose last observation and infos move aside."""
        infos = _infos(said, ~done)
        if done.any():
            infos |= {"final_obs": _separate(self._observe(), done), "_final_obs": done.copy()}
            infos |= {"final_info": _infos(said, done), "_final_info": done.copy()}
            infos |= _infos(self._slots.begin(done), done)
        return infos

    def _observe(self) -> Any:
        return self._slots.observe()

    def close_extras(self, **kwargs: Any) -> None:
        """Close the batch."""
        self.batch.close()


def _action_space() -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)


def _seeds(seed: int | Sequence[int | None] | None, count: int) -> Sequence[int | None]:
    if seed is None:
        return [None] * count
    if isinstance(seed, int | np.integer):
        return [int(seed) + slot for slot in range(count)]
    if len(seed) != count:
        raise ValueError(f"{len(seed)} seeds for {count} sub-environments; expected one each, or a single one")
    return seed


def _reset_mask(mask: Any, count: int) -> np.ndarray:
    if mask is None:
        return np.ones(count, bool)
    if not isinstance(mask, np.ndarray) or mask.dtype != bool:
        raise TypeError(f"options['reset_mask'] is {mask!r}; expected a NumPy array of bool")
    if mask.shape != (count,) or not mask.any():
        raise ValueError(f"options['reset_mask'] is {mask}; expected shape ({count},) and at least one True")
    return mask


def _infos(said: Mapping[str, np.ndarray], mask: np.ndarray) -> dict[str, Any]:
    """Gymnasium's infos: each array with nothing in it where the mask is False, and the mask."""
    infos: dict[str, Any] = {}
    for name, values in said.items() if mask.any() else ():
        nothing = np.full(values.shape, None, object) if values.dtype == object else np.zeros_like(values)
        nothing[mask] = values[mask]
        infos |= {name: nothing, f"_{name}": mask.copy()}
    return infos


def _separate(observations: Observation, mask: np.ndarray) -> np.ndarray:
    """Observations of single sub-environments where the mask holds and None elsewhere, object [B]."""
    out = np.full(len(mask), None, object)
    for slot in np.flatnonzero(mask):
        out[slot] = _row(observations, slot)
    return out


def _row(observations: Observation, slot: Any) -> Any:
    if isinstance(observations, dict):
        return {name: values[slot].copy() for name, values in observations.items()}
    return observations[slot].copy()


class Env(gymnasium.Env[Any, np.ndarray]):
    """One LIBERO episode after the other as ``gymnasium.Env``; observations and infos are those of ``VectorEnv``.

    Args:
        suite: one of ``vecenv.list_suites()``.
        task: its task.
        episodes: the init states it goes through; None for all 50.
        obs: see ``VectorEnv``.
        options: as for ``vecenv.make``.

    Raises:
        GymnasiumError: an observation that does not exist; and what ``vecenv.make`` raises.

    Attributes:
        batch: the batch of one slot behind it.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own way

    def __init__(
        self,
        suite: str,
        *,
        task: int = 0,
        episodes: Any = None,
        obs: str | Sequence[str] = OBSERVATIONS,
        **options: Any,
    ) -> None:
        pool = _chosen(episodes)
        self.batch = _made(suite, task, pool[:1], options)
        self._slots = _Slots(self.batch, pool, obs)
        self.layout = self._slots.observe.layouts[0]
        self.action_space = _action_space()
        self.observation_space = self._slots.observe.space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode.

        Args:
            seed: what decides which episodes come, see the module; None to go on.
            options: ``episode``: the init state to begin with.

        Raises:
            GymnasiumError, PlacementError: an option or episode that does not exist.
        """
        super().reset(seed=seed)
        if seed is not None:
            self._slots.seed(0, self.np_random)
        episode = _check_options(options, ("episode",)).get("episode")
        said = self._slots.begin(np.ones(1, bool), episode)
        return self._observe(), {name: values[0] for name, values in said.items()}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance by one tick, 50 ms.

        Args:
            action: [7] in [-1, 1].

        Raises:
            LiberoError: before the first ``reset``.
            ActionError: an action of another shape.
        """
        control, said = self._slots.step(np.asarray(action)[None])
        flags = bool(control.terminated[0]), bool(control.truncated[0])
        return self._observe(), float(control.reward[0]), *flags, {name: x.tolist()[0] for name, x in said.items()}

    def _observe(self) -> Any:
        return _row(self._slots.observe(), 0)

    def close(self) -> None:
        """Close the batch; closing twice is harmless."""
        self.batch.close()


def make_vec(
    suite: str,
    *,
    task: int = 0,
    num_envs: int = 1,
    episodes: Any = None,
    obs: str | Sequence[str] = OBSERVATIONS,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    **options: Any,
) -> VectorEnv:
    """Sub-environments of one task, what ``gymnasium.make_vec`` calls.

    Args:
        suite, task: which task.
        num_envs: how many; they begin with the first, second, ... of the episodes.
        episodes: the init states each goes through, as for ``vecenv.make``; None for all 50.
        obs, autoreset_mode: see ``VectorEnv``.
        options: as for ``vecenv.make``.

    Raises:
        GymnasiumError, PlacementError: an option that does not exist; and what ``vecenv.make`` raises.
    """
    pool = _chosen(episodes)
    if num_envs < 1:
        raise GymnasiumError(f"num_envs={num_envs}: expected at least 1")
    batch = _made(suite, task, [pool[slot % len(pool)] for slot in range(num_envs)], options)
    return VectorEnv(batch, episodes=pool, obs=obs, autoreset_mode=autoreset_mode)


def _chosen(episodes: Any) -> list[int]:
    wanted = range(NUM_EPISODES) if episodes is None else episodes
    return placement.cross(0, wanted, num_tasks=1, num_episodes=NUM_EPISODES).episode.tolist()


def _made(suite: str, task: int, episodes: Sequence[int], options: Mapping[str, Any]) -> LiberoEnv:
    batch = vecenv.make(suite, task=task, episodes=episodes, **options)
    if not isinstance(batch, LiberoEnv):
        raise GymnasiumError(f"suite={suite!r}: expected one of {', '.join(list_suites())}")
    return batch


def env_ids(suites: Iterable[str] | None = None) -> tuple[str, ...]:
    """Ids of the tasks of some suites, all by default: ``"vecenv/<suite>-<task>-v0"``.

    Raises:
        UnknownSuite: no such suite.
    """
    return tuple(_id(suite, task) for suite, task in _tasks(suites))


def register_envs(suites: Iterable[str] | None = None) -> tuple[str, ...]:
    """Make ``gymnasium.make`` and ``gymnasium.make_vec`` know the tasks of some suites, all by default.

    Doing it twice is harmless. ``make_vec`` then makes one batch, unless told ``vectorization_mode="sync"``.

    Returns:
        Their ids.
    """
    for suite, task in _tasks(suites):
        if _id(suite, task) not in gymnasium.registry:
            gymnasium.register(
                _id(suite, task),
                entry_point=f"{__name__}:Env",
                vector_entry_point=f"{__name__}:make_vec",
                kwargs={"suite": suite, "task": task},
            )
    return env_ids(suites)


def _tasks(suites: Iterable[str] | None) -> list[tuple[str, int]]:
    chosen = list_suites() if suites is None else suites
    return [(suite, task) for suite in chosen for task in range(_count(suite))]


@functools.cache
def _count(suite: str) -> int:
    return len(list_tasks(suite))


def _id(suite: str, task: int) -> str:
    return f"vecenv/{suite}-{task}-v0"
