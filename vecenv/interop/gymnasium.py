"""LIBERO and SIMPLER tasks as Gymnasium environments: a batch as ``VectorEnv``, one episode at a time as ``Env``.

In: a batch that ``vecenv.make`` returned, on any backend, or the name of a task. Out: ``VectorEnv``, whose
sub-environments are the slots of the batch, in any of Gymnasium's three autoreset modes; and ``Env``, a batch of one.
Ids such as ``vecenv/libero_object-0-v0`` are registered when ``vecenv.interop.ids`` is imported, as it is from here::

    envs = gymnasium.make_vec("vecenv/libero_object-0-v0", num_envs=8, obs="pixels+state", max_episode_steps=300)
    envs = VectorEnv(vecenv.make("libero_object", tasks=[0, 1], backend="warp"), autoreset_mode="SameStep")

A sub-environment keeps its task and goes through the task's episodes: it plays each once before any comes again,
beginning with the one that was placed and in the order given; once seeded, in random orders that its seed decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

import vecenv
from vecenv import placement
from vecenv.contract import ACTION_DIM
from vecenv.interop.episodes import EpisodeChoice, EpisodeSlots, check_options, num_episodes
from vecenv.interop.ids import env_ids, register_envs
from vecenv.interop.observing import Batch, GymnasiumError, Observation
from vecenv.libero.env import LiberoEnv

__all__ = ["Env", "GymnasiumError", "VectorEnv", "env_ids", "make_vec", "register_envs"]

RENDER_MODES = ("rgb_array",)
# Gymnasium's infos: arrays by name, and under ``_name`` which sub-environments they are about.
Infos: TypeAlias = "dict[str, Any]"


class VectorEnv(gymnasium.vector.VectorEnv[Observation, np.ndarray, np.ndarray]):
    """A batch of episodes as Gymnasium's vector environment.

    Observations, by name:

    * ``pixels``: one entry for each camera, ``agentview`` and in LIBERO ``wrist``, uint8 [H, W, 3].
    * ``state`` and ``proprio``: ``observe_egocentric().state``, float32; 8 numbers in LIBERO.
    * ``objects`` (LIBERO): pose (xyz in metres, wxyz, world frame) of each object and fixture and the joints of the
      fixtures, float32; see ``layouts``. With scenes of different size in a batch it is padded with zeros.

    Actions are those of ``step_continuous``. ``infos`` of a step hold ``success``, ``is_success`` (the same),
    ``step_index``, ``sanitized`` and ``fault`` (as in ``contract.Control``), those of a beginning episode
    ``episode_id`` and ``instruction``, each with a mask ``_name`` of the sub-environments it is about; with
    ``SAME_STEP`` also ``final_obs`` and ``final_info``.

    Args:
        env: the batch, not used by anyone else; closed with this one.
        episodes: what a slot goes through, for all tasks or a mapping task -> episodes; None for those of its task that
            the batch was made with.
        obs: one name for an array, several joined by ``+`` (``"pixels+state"``) or in a sequence for a dictionary;
            None for ``proprio`` and, in LIBERO, ``objects``.
        autoreset_mode: what happens to an episode that ended: ``NEXT_STEP``, its next step begins a new one;
            ``SAME_STEP``, a new one begins at once; ``DISABLED``, call ``reset`` with a mask.
        cameras: whose images; None for the ones above. The first is what ``render`` shows.
        render_mode: ``"rgb_array"`` or None.

    Raises:
        GymnasiumError, PlacementError: an observation, camera, render mode or episode that does not exist.

    Attributes:
        batch: the batch, for its other verbs (``evaluate``, ``observe_objects``, ``state``).
        layouts: where what is in ``objects``, for each slot: name -> columns.
    """

    def __init__(
        self,
        env: Batch,
        *,
        episodes: EpisodeChoice = None,
        obs: str | Sequence[str] | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        cameras: Sequence[str] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.batch, self.num_envs = env, env.num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.render_mode = _render_mode(render_mode)
        self.metadata = {**_metadata(env), "autoreset_mode": self.autoreset_mode}
        self._slots = EpisodeSlots(env, episodes, obs, cameras)
        self.layouts = self._slots.observe.layouts
        self.single_action_space = _action_space(env)
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
    ) -> tuple[Observation, Infos]:
        """Begin a new episode in every sub-environment, or in some.

        Args:
            seed: what decides which episodes come, see the module; one number s for s, s + 1, ..., or one a
                sub-environment, or None to continue.
            options: ``reset_mask``, bool [B]: those to reset, the others stay as they are; ``episode``: the init state
                to begin with, one for all or [B].

        Raises:
            TypeError, ValueError: not a mask, or a wrong number of seeds.
            GymnasiumError, PlacementError: an option or episode that does not exist.
        """
        options = dict(check_options(options, ("reset_mask", "episode")))
        mask = _reset_mask(options.get("reset_mask"), self.num_envs)
        for slot, number in enumerate(_seeds(seed, self.num_envs)):
            if number is not None and mask[slot]:
                self._seeded[slot] = seeding.np_random(number)
                self._slots.seed(slot, self._generator(slot)[0])
        said = self._slots.begin(mask, options.get("episode"))
        self._begun |= mask
        self._ended &= ~mask
        return self._observe(), _infos(said, mask)

    def step(self, actions: npt.ArrayLike) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, Infos]:
        """Advance every sub-environment by one tick of ``batch.control_hz``.

        Args:
            actions: [B, 7], in LIBERO in [-1, 1], see ``vecenv.contract``.

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

    def _restart(self, said: Mapping[str, np.ndarray], done: np.ndarray) -> Infos:
        """Begin new episodes where some ended, whose last observation and infos move aside."""
        infos = _infos(said, ~done)
        if done.any():
            infos |= {"final_obs": _separate(self._observe(), done), "_final_obs": done.copy()}
            infos |= {"final_info": _infos(said, done), "_final_info": done.copy()}
            infos |= _infos(self._slots.begin(done), done)
        return infos

    def _observe(self) -> Observation:
        return self._slots.observe()

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The first camera's image of each sub-environment, uint8 [H, W, 3]; None without a render mode."""
        return self._slots.observe.frames() if self.render_mode else None

    def close_extras(self, **kwargs: object) -> None:
        """Close the batch."""
        self.batch.close()


def _action_space(env: Batch) -> spaces.Box:
    if isinstance(env, LiberoEnv):
        return spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
    from vecenv.simpler.env import ACTION_LIMITS

    limits = ACTION_LIMITS.astype(np.float32)
    return spaces.Box(-limits, limits, dtype=np.float32)


def _render_mode(mode: str | None) -> str | None:
    if mode is not None and mode not in RENDER_MODES:
        raise GymnasiumError(f"render_mode={mode!r}: expected {', '.join(map(repr, RENDER_MODES))} or None")
    return mode


def _metadata(env: Batch) -> dict[str, Any]:
    return {"render_modes": list(RENDER_MODES), "render_fps": round(env.control_hz)}


def _seeds(seed: int | Sequence[int | None] | None, count: int) -> Sequence[int | None]:
    if seed is None:
        return [None] * count
    if isinstance(seed, int | np.integer):
        return [int(seed) + slot for slot in range(count)]
    if len(seed) != count:
        raise ValueError(f"{len(seed)} seeds for {count} sub-environments; expected one each, or a single one")
    return seed


def _reset_mask(mask: object, count: int) -> np.ndarray:
    if mask is None:
        return np.ones(count, bool)
    if not isinstance(mask, np.ndarray) or mask.dtype != bool:
        raise TypeError(f"options['reset_mask'] is {mask!r}; expected a NumPy array of bool")
    if mask.shape != (count,) or not mask.any():
        raise ValueError(f"options['reset_mask'] is {mask}; expected shape ({count},) and at least one True")
    return mask


def _infos(said: Mapping[str, np.ndarray], mask: np.ndarray) -> Infos:
    """Gymnasium's infos: each array with nothing in it where the mask is False, and the mask."""
    infos: Infos = {}
    for name, values in said.items() if mask.any() else ():
        nothing = np.full(values.shape, None, object) if values.dtype == object else np.zeros_like(values)
        nothing[mask] = values[mask]
        infos |= {name: nothing, f"_{name}": mask.copy()}
    return infos


def _separate(observations: Observation, mask: np.ndarray) -> np.ndarray:
    """Observations of single sub-environments where the mask holds and None elsewhere, object [B]."""
    out = np.full(len(mask), None, object)
    for slot in np.flatnonzero(mask).tolist():
        out[slot] = _row(observations, slot)
    return out


def _row(observations: Observation, slot: int) -> Observation:
    if isinstance(observations, dict):
        return {name: values[slot].copy() for name, values in observations.items()}
    return observations[slot].copy()


class Env(gymnasium.Env[Observation, np.ndarray]):
    """One episode after the other as ``gymnasium.Env``; observations and infos are those of ``VectorEnv``.

    Args:
        suite: one of ``vecenv.list_suites()``.
        task: its task, by index or name.
        episodes: the episodes it goes through; None for all.
        obs, cameras, render_mode: see ``VectorEnv``.
        max_episode_steps: the budget of an episode in ticks, after which it is truncated: another name of the option
            ``max_steps`` of ``vecenv.make``. None for the protocol's.
        options: as for ``vecenv.make``.

    Raises:
        GymnasiumError: an observation, camera or render mode that does not exist; and what ``vecenv.make`` raises.

    Attributes:
        batch: the batch of one slot behind it.
        layout: where what is in ``objects``: name -> columns.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012 - Gymnasium's own way

    def __init__(
        self,
        suite: str,
        *,
        task: int | str = 0,
        episodes: EpisodeChoice = None,
        obs: str | Sequence[str] | None = None,
        cameras: Sequence[str] | None = None,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **options: object,
    ) -> None:
        self.render_mode = _render_mode(render_mode)
        options = _with_budget(options, max_episode_steps)
        index, pool = _chosen(suite, task, episodes, options)
        self.batch = _made(suite, index, pool[:1], options)
        self.metadata = _metadata(self.batch)
        self._slots = EpisodeSlots(self.batch, {index: pool}, obs, cameras)
        self.layout = self._slots.observe.layouts[0]
        self.action_space = _action_space(self.batch)
        self.observation_space = self._slots.observe.space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Infos]:
        """Begin the next episode.

        Args:
            seed: what decides which episodes come, see the module; None to continue.
            options: ``episode``: the one to begin with.

        Raises:
            GymnasiumError, PlacementError: an option or episode that does not exist.
        """
        super().reset(seed=seed)
        if seed is not None:
            self._slots.seed(0, self.np_random)
        episode = check_options(options, ("episode",)).get("episode")
        said = self._slots.begin(np.ones(1, bool), episode)
        return self._observe(), {name: values[0] for name, values in said.items()}

    def step(self, action: npt.ArrayLike) -> tuple[Observation, float, bool, bool, Infos]:
        """Advance by one tick of ``batch.control_hz``.

        Args:
            action: [7], in LIBERO in [-1, 1].

        Raises:
            LiberoError, SimplerError: before the first ``reset``.
            ActionError: an action of another shape.
        """
        control, said = self._slots.step(np.asarray(action)[None])
        flags = bool(control.terminated[0]), bool(control.truncated[0])
        return self._observe(), float(control.reward[0]), *flags, {name: x.tolist()[0] for name, x in said.items()}

    def render(self) -> np.ndarray | None:
        """The first camera's image, uint8 [H, W, 3]; None without a render mode."""
        return self._slots.observe.frames()[0] if self.render_mode else None

    def _observe(self) -> Observation:
        return _row(self._slots.observe(), 0)

    def close(self) -> None:
        """Close the batch; closing twice is harmless."""
        self.batch.close()


def make_vec(
    suite: str,
    *,
    task: int | str = 0,
    num_envs: int = 1,
    episodes: EpisodeChoice = None,
    obs: str | Sequence[str] | None = None,
    autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    cameras: Sequence[str] | None = None,
    render_mode: str | None = None,
    max_episode_steps: int | None = None,
    **options: object,
) -> VectorEnv:
    """Sub-environments of one task, what ``gymnasium.make_vec`` calls.

    Args:
        suite, task: which task, by index or name.
        num_envs: how many; they begin with the first, second, ... of the episodes.
        episodes: the episodes each goes through, as for ``vecenv.make``; None for all.
        obs, autoreset_mode, cameras, render_mode: see ``VectorEnv``.
        max_episode_steps, options: see ``Env``.

    Raises:
        GymnasiumError, PlacementError: an option that does not exist; and what ``vecenv.make`` raises.
    """
    options = _with_budget(options, max_episode_steps)
    index, pool = _chosen(suite, task, episodes, options)
    if num_envs < 1:
        raise GymnasiumError(f"num_envs={num_envs}: expected at least 1")
    batch = _made(suite, index, [pool[slot % len(pool)] for slot in range(num_envs)], options)
    return VectorEnv(
        batch,
        episodes={index: pool},
        obs=obs,
        autoreset_mode=autoreset_mode,
        cameras=cameras,
        render_mode=render_mode,
    )


def _with_budget(options: Mapping[str, object], max_episode_steps: int | None) -> dict[str, object]:
    """Options of ``vecenv.make``, with the budget of episodes under its name there."""
    if max_episode_steps is None:
        return dict(options)
    if options.get("max_steps") is not None:
        raise GymnasiumError("max_steps and max_episode_steps are the same option; give one of them")
    return {**options, "max_steps": max_episode_steps}


def _chosen(
    suite: str, task: int | str, episodes: EpisodeChoice, options: Mapping[str, object]
) -> tuple[int, list[int]]:
    """The task's index and the episodes that were asked for."""
    (index,) = placement.task_indices(task, [each.name for each in vecenv.list_tasks(suite)])
    fields = dict(options)
    config: Any = fields.pop("config", None)
    config = vecenv.make_config(suite, fields, config)
    counts = dict(enumerate(num_episodes(suite, config.protocol)))
    placed = placement.cross(index, episodes, num_tasks=len(counts), num_episodes=counts)
    return index, placed.episode.tolist()


def _made(suite: str, task: int, episodes: Sequence[int], options: Mapping[str, Any]) -> Batch:
    batch: Any = vecenv.make(suite, tasks=[task], episodes=episodes, **options)
    return batch
