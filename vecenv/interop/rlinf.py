"""LIBERO behind the interface of RLinf's ``LiberoEnv``: one batch in place of a process an environment.

In: RLinf's environment configuration (``examples/embodiment/config/env/libero_*.yaml``), number of environments, rank.
Out: ``RLinfEnv``, whose ``reset``, ``step`` and ``chunk_step`` return torch tensors in RLinf's dictionaries, whose
order of reset states is RLinf's for the same seed, and whose rewards, metrics and auto-resets follow RLinf's file
``rlinf/envs/libero/libero_env.py``, read at commit a3816b5. In RLinf, return it from ``rlinf.envs.get_env_cls`` for
``env_type: libero``::

    from vecenv.interop.rlinf import RLinfEnv

A reset state is an episode of a task: ids count the episodes of task 0, then those of task 1, and so on.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

import vecenv
from vecenv.contract import ACTION_DIM
from vecenv.errors import InvalidInput, MissingDependency
from vecenv.interop.reset_states import ResetStates
from vecenv.interop.scattered import ScatteredBatch
from vecenv.observations import Rendered

try:
    import torch  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise MissingDependency("vecenv.interop.rlinf returns torch tensors: pip install torch", name="torch") from error

# Ticks without motion, gripper opening, that RLinf steps after every reset.
IDLE_STEPS = 15
_NO_BUDGET = 10**9
RLinfObs: TypeAlias = "dict[str, torch.Tensor | list[str]]"
RLinfInfos: TypeAlias = "dict[str, Any]"


class RLinfError(InvalidInput):
    """An option of RLinf's configuration that cannot be honoured; the message says what would be right."""


class RLinfEnv:
    """RLinf's LIBERO environment on a vecenv batch.

    Args:
        cfg: RLinf's environment configuration: an OmegaConf node or a mapping, read by key. ``vecenv`` in it, a
            mapping, holds further options of ``vecenv.make`` (``backend``, ``num_threads``, ``fixtures``).
        num_envs: environments of this process, B.
        seed_offset: rank of this process among ``total_num_processes``.
        total_num_processes: over which reset states are spread.
        worker_info: RLinf's; kept.

    Raises:
        RLinfError: an option that cannot be honoured; and what ``vecenv.make`` raises.

    Attributes:
        is_start: whether the next ``reset`` is the first of a rollout, as RLinf's workers set it.
        task_ids, trial_ids: task and init state of each environment, int [B].
        task_descriptions: instruction of each environment.
        success_once, returns: of the present episodes, [B].
    """

    def __init__(
        self,
        cfg: Mapping[str, Any],
        num_envs: int,
        seed_offset: int,
        total_num_processes: int,
        worker_info: object = None,
    ) -> None:
        self.cfg, self.num_envs, self.seed_offset = cfg, num_envs, seed_offset
        self.total_num_processes, self.worker_info = total_num_processes, worker_info
        self.seed = int(cfg["seed"]) + seed_offset
        self.group_size = int(cfg["group_size"])
        self.num_group = num_envs // self.group_size
        if num_envs < 1 or num_envs % self.group_size:
            raise RLinfError(f"num_envs={num_envs} is not a positive multiple of group_size={self.group_size}")
        if not cfg["reset_gripper_open"]:
            raise RLinfError("reset_gripper_open=False: resets open the gripper here; set it to True")
        self.use_fixed_reset_state_ids = bool(cfg["use_fixed_reset_state_ids"])
        self.ignore_terminations, self.auto_reset = bool(cfg["ignore_terminations"]), bool(cfg["auto_reset"])
        self.is_eval = bool(cfg.get("is_eval", False))
        self.use_rel_reward = bool(cfg["use_rel_reward"])
        self.use_step_penalty = bool(cfg.get("use_step_penalty", False))
        self.max_episode_steps, self._reward_coef = int(cfg["max_episode_steps"]), float(cfg["reward_coef"])
        self.video_cfg = cfg.get("video_cfg")
        self.is_start = True
        suite = str(cfg["task_suite_name"])
        self._states = ResetStates(
            num_tasks=len(vecenv.list_tasks(suite)),
            tasks=cfg.get("task_id_filter"),
            only=cfg.get("specific_reset_id"),
            seed=self.seed,
            rank=seed_offset,
            processes=total_num_processes,
            evaluating=self.is_eval,
            ordered=bool(cfg.get("use_ordered_reset_state_ids", False)),
        )
        self.batch = ScatteredBatch(suite, num_envs, self._fields())
        self.update_reset_state_ids()
        self.task_ids, self.trial_ids = self._states.split(self.reset_state_ids)
        self._begin_metrics()

    def _fields(self) -> dict[str, Any]:
        size = self.cfg.get("init_params") or {}
        render = {"height": int(size.get("camera_heights", 256)), "width": int(size.get("camera_widths", 256))}
        # Budget and verdict are RLinf's own: an episode goes on after success, and its end is counted here.
        return {
            "protocol": "rlinf",
            "start": "raw",
            "settle_steps": IDLE_STEPS,
            "seed": self.seed,
            "render": render,
            **dict(self.cfg.get("vecenv") or {}),
            "success": "final",
            "max_steps": _NO_BUDGET,
        }

    # -- which episode comes next --------------------------------------------------------------------------------------

    def update_reset_state_ids(self) -> None:
        """Draw the reset states of the next rollout, one a group; those of a group are the same."""
        self.reset_state_ids = self._states.draw(self.num_group).repeat(self.group_size)

    @property
    def total_num_group_envs(self) -> int:
        """How many reset states the suite has."""
        return self._states.total

    @property
    def task_descriptions(self) -> list[str]:
        """Instruction of each environment."""
        return list(self.batch.instructions())

    # -- metrics -------------------------------------------------------------------------------------------------------

    @property
    def elapsed_steps(self) -> np.ndarray:
        """Ticks of the present episodes, int [B]."""
        return self._elapsed_steps

    @property
    def info_logging_keys(self) -> list[str]:
        """As in RLinf: none."""
        return []

    def _begin_metrics(self) -> None:
        self.success_once, self.fail_once = np.zeros((2, self.num_envs), bool)
        self.returns, self.prev_step_reward = np.zeros((2, self.num_envs))
        self.success_episode_len, self._elapsed_steps = np.zeros((2, self.num_envs), np.int32)
        self._task_success_stats: dict[int, dict[str, int]] = {}
        self._seen_trials: set[tuple[int, int]] = set()

    def _reset_metrics(self, rows: np.ndarray) -> None:
        for array in (
            *(self.prev_step_reward, self.success_once, self.fail_once, self.returns),
            *(self.success_episode_len, self._elapsed_steps),
        ):
            array[rows] = 0

    def _record(self, reward: np.ndarray, solved: np.ndarray) -> dict[str, torch.Tensor]:
        """Metrics of the present episodes after a tick; returns count until the first success."""
        self.returns += reward * ~self.success_once
        first = solved & ~self.success_once
        self.success_episode_len[first] = self._elapsed_steps[first]
        self.success_once = self.success_once | solved
        length = np.where(self.success_once, self.success_episode_len, self._elapsed_steps)
        return {
            "success_once": _tensor(self.success_once),
            "return": _tensor(self.returns),
            "episode_len": _tensor(self._elapsed_steps),
            "reward": _tensor(self.returns / np.maximum(length, 1)),
        }

    def _reward(self, solved: np.ndarray) -> np.ndarray:
        reward = self._reward_coef * solved - (1.0 if self.use_step_penalty else 0.0)
        if not self.use_rel_reward:
            return reward
        before, self.prev_step_reward = self.prev_step_reward, reward
        return reward - before

    # -- episodes ------------------------------------------------------------------------------------------------------

    def reset(
        self,
        env_idx: int | Sequence[int] | np.ndarray | None = None,
        reset_state_ids: npt.ArrayLike | None = None,
    ) -> tuple[RLinfObs, RLinfInfos]:
        """Begin episodes in some environments, all by default; 15 idle ticks later they are observed.

        Args:
            env_idx: which.
            reset_state_ids: of each of them; None for random ones, and at the start of a rollout (``is_start``) with
                ``use_fixed_reset_state_ids`` for those that ``update_reset_state_ids`` drew.

        Returns:
            The observation of all environments, and no infos.
        """
        rows = np.arange(self.num_envs) if env_idx is None else np.atleast_1d(np.asarray(env_idx, int))
        chosen = None if reset_state_ids is None else np.asarray(reset_state_ids, int)
        if self.is_start:
            if self.is_eval:
                self._task_success_stats, self._seen_trials = {}, set()
                self._states.rewind()
                self.update_reset_state_ids()
            chosen = self.reset_state_ids[rows] if self.use_fixed_reset_state_ids else None
            self.is_start = False
        if chosen is None:
            chosen = self._states.random(len(rows))
        self.task_ids[rows], self.trial_ids[rows] = self._states.split(chosen)
        self.batch.begin(rows, self.task_ids[rows], self.trial_ids[rows])
        self._reset_metrics(rows)
        return self._observe(), {}

    def step(
        self, actions: torch.Tensor | np.ndarray, auto_reset: bool = True
    ) -> tuple[RLinfObs, torch.Tensor, torch.Tensor, torch.Tensor, RLinfInfos]:
        """Advance all environments by one tick, 50 ms.

        Args:
            actions: [B, 7].
            auto_reset: whether ended episodes are followed by others, if the configuration says so too.

        Returns:
            Observation, rewards float32 [B], terminations and truncations bool [B], and infos, whose ``episode`` has
            the metrics. An environment whose physics failed is truncated.
        """
        given = actions if isinstance(actions, np.ndarray) else actions.detach().cpu().numpy()
        self._elapsed_steps += 1
        solved, failed = self.batch.step(given.reshape(self.num_envs, ACTION_DIM))
        truncated = (self._elapsed_steps >= self.max_episode_steps) | failed
        reward = self._reward(solved)
        infos: RLinfInfos = {"episode": self._record(reward, solved)}
        terminated = solved.copy()
        if self.ignore_terminations:
            infos["episode"]["success_at_end"] = _tensor(solved)
            terminated[:] = False
        obs, done = self._observe(), terminated | truncated
        if done.any() and auto_reset and self.auto_reset:
            obs, infos, _ = self._auto_reset(done, obs, infos)
        return obs, _tensor(reward), _tensor(terminated), _tensor(truncated), infos

    def chunk_step(
        self, chunk_actions: torch.Tensor | np.ndarray
    ) -> tuple[list[RLinfObs], torch.Tensor, torch.Tensor, torch.Tensor, list[RLinfInfos]]:
        """Advance by a chunk of K ticks; episodes that end within it go on to its end.

        Args:
            chunk_actions: [B, K, 7].

        Returns:
            K observations, rewards, terminations and truncations [B, K], and K infos. With ``auto_reset`` or
            ``ignore_terminations`` ends are reported at the last tick only.
        """
        ticks = [self.step(chunk_actions[:, k], auto_reset=False) for k in range(chunk_actions.shape[1])]
        obs, infos = [tick[0] for tick in ticks], [tick[4] for tick in ticks]
        reward, terminated, truncated = (torch.stack([tick[part] for tick in ticks], dim=1) for part in (1, 2, 3))
        ends = terminated.any(dim=1), truncated.any(dim=1)
        done, counted = (ends[0] | ends[1]).numpy(), None
        if done.any() and self.auto_reset:
            obs[-1], infos[-1], counted = self._auto_reset(done, obs[-1], infos[-1])
        if self.auto_reset or self.ignore_terminations:
            counts = torch.tensor(np.ones(self.num_envs, bool) if counted is None else counted)
            terminated, truncated = torch.zeros_like(terminated), torch.zeros_like(truncated)
            terminated[:, -1], truncated[:, -1] = ends[0] & counts, ends[1] & counts
        return obs, reward, terminated, truncated, infos

    def _auto_reset(
        self, done: np.ndarray, final_obs: RLinfObs, infos: RLinfInfos
    ) -> tuple[RLinfObs, RLinfInfos, np.ndarray | None]:
        """Begin other episodes where some ended; in evaluations also which of the ends count."""
        final_obs, final_infos, rows = copy.deepcopy(final_obs), copy.deepcopy(infos), np.flatnonzero(done)
        counted = self._count(rows) if self.is_eval else None
        obs, fresh = final_obs, {}
        if self.is_eval:
            following = self._states.draw(len(rows))
            rows = rows[following >= 0]
            self.reset_state_ids[rows] = following[following >= 0]
        elif self.use_fixed_reset_state_ids:
            self.update_reset_state_ids()
        if len(rows):
            fixed = self.is_eval or self.use_fixed_reset_state_ids
            obs, fresh = self.reset(rows, self.reset_state_ids[rows] if fixed else None)
        fresh |= {
            "final_observation": final_obs,
            "final_info": final_infos,
            "_final_info": done if counted is None else done & counted,
            "_final_observation": done,
            "_elapsed_steps": done,
        }
        return obs, fresh, counted

    def _count(self, rows: np.ndarray) -> np.ndarray:
        """Which ends count towards an evaluation, bool [B]: each task and init state once."""
        counted = np.zeros(self.num_envs, bool)
        for row in rows.tolist():
            trial = int(self.task_ids[row]), int(self.trial_ids[row])
            if trial in self._seen_trials:
                continue
            self._seen_trials.add(trial)
            counted[row] = True
            stats = self._task_success_stats.setdefault(trial[0], {"success": 0, "total": 0})
            stats["total"] += 1
            stats["success"] += int(self.success_once[row])
        return counted

    def _observe(self) -> RLinfObs:
        seen = self.batch.observe()
        if isinstance(seen.images, Rendered):
            seen.images.prepare("agentview", "wrist")
        return {
            "main_images": _tensor(seen.images["agentview"]),
            "wrist_images": _tensor(seen.images["wrist"]),
            "states": _tensor(seen.state),
            "task_descriptions": self.task_descriptions,
        }

    def close(self) -> None:
        """Release the batch; closing twice is harmless."""
        self.batch.close()


def _tensor(values: np.ndarray) -> torch.Tensor:
    """A copy as a tensor; float64 becomes float32, as in RLinf."""
    return torch.tensor(values.astype(np.float32) if values.dtype == np.float64 else values)
