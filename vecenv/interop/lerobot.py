"""vecenv's tasks as LeRobot's evaluation reads environments: a vector environment a task, in ``{suite: {task: env}}``.

In: suites, tasks and image options. Out: ``LeRobotVectorEnv``, whose observations are what LeRobot's
``preprocess_observation`` expects: ``pixels``, uint8 images (``image``, and in LIBERO ``image2``), and ``agent_pos``.
Nothing here imports LeRobot; the package ``lerobot_env_vecenv`` beside this project tells LeRobot about it::

    lerobot-eval --policy.path=... --env.type=vecenv --env.task=libero_object --eval.batch_size=10

LIBERO's images are turned by 180 degrees, as LeRobot's own processor turns them, so no processor is needed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

import vecenv
from vecenv import placement, protocols
from vecenv.contract import ACTION_DIM, Control, ResetInfo
from vecenv.errors import InvalidInput
from vecenv.interop.episodes import num_episodes
from vecenv.interop.observing import Batch
from vecenv.observations import Rendered

# The names of the cameras' images in LeRobot's LIBERO data sets and checkpoints.
CAMERA_NAMES: Mapping[str, str] = {"agentview": "image", "wrist": "image2"}
OBS_TYPES = ("pixels", "pixels_agent_pos")
PROTOCOL = "lerobot"

LeRobotObservation: TypeAlias = "dict[str, np.ndarray | dict[str, np.ndarray]]"


class LeRobotError(InvalidInput):
    """An option or call that these environments do not have; the message says what would be right."""


@dataclass(frozen=True, kw_only=True)
class LeRobotOptions:
    """How LeRobot's environments are made; ``lerobot_env_vecenv`` fills it from ``--env.*``.

    Attributes:
        obs_type: ``"pixels_agent_pos"`` or ``"pixels"``.
        height, width: of LIBERO's images, pixels; SIMPLER's have the camera's own size.
        episode_length: budget of an episode in ticks; None for LeRobot's (LIBERO) or the task's own (SIMPLER).
        fields: further options of ``vecenv.make``, such as ``backend`` and ``num_threads``.
    """

    obs_type: str = "pixels_agent_pos"
    height: int = 360
    width: int = 360
    episode_length: int | None = None
    fields: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.obs_type not in OBS_TYPES:
            raise LeRobotError(f"obs_type={self.obs_type!r}: expected one of {', '.join(OBS_TYPES)}")
        if "cameras" in self.fields:
            raise LeRobotError("cameras: LeRobot's policies expect the images under the names of its own data sets")

    def of_suite(self, suite: str) -> dict[str, object]:
        """Options of ``vecenv.make``."""
        given = dict(self.fields)
        if vecenv.family(suite) == protocols.LIBERO:
            given = {"protocol": PROTOCOL, "render": {"height": self.height, "width": self.width}, **given}
        return given if self.episode_length is None else {**given, "max_steps": self.episode_length}


def image_shapes(suite: str, options: LeRobotOptions) -> dict[str, tuple[int, int, int]]:
    """Shapes of a suite's images by their name in observations, (height, width, 3)."""
    if vecenv.family(suite) == protocols.LIBERO:
        return dict.fromkeys(CAMERA_NAMES.values(), (options.height, options.width, 3))
    camera: Any = vecenv.list_tasks(suite)[0]
    return {CAMERA_NAMES["agentview"]: (camera.camera.height, camera.camera.width, 3)}


def state_width(suite: str) -> int:
    """How many numbers ``agent_pos`` has: position, axis-angle and fingers in LIBERO; see ``Egocentric.state``."""
    if vecenv.family(suite) == protocols.LIBERO:
        return 8
    task: Any = vecenv.list_tasks(suite)[0]
    return 2 * task.robot.dof + 7


class LeRobotVectorEnv(gymnasium.vector.VectorEnv[LeRobotObservation, np.ndarray, np.ndarray]):
    """The episodes of one task, ``num_envs`` at a time, for LeRobot's ``rollout`` and ``eval_policy``.

    Sub-environment i plays the episodes i, i + n, i + 2 n, ... of the task, one at each ``reset``. An episode that has
    ended stays as it is, at no cost, until then: LeRobot discards what comes after it. The batch is made at the first
    ``reset`` and released by ``close``, after which another ``reset`` makes it again and continues.

    Args:
        suite: one of ``vecenv.list_suites()``.
        task: index of its task.
        num_envs: sub-environments, n.
        options: see ``LeRobotOptions``.

    Raises:
        OptionError: an option that the suite does not have.
    """

    def __init__(self, suite: str, task: int, num_envs: int, options: LeRobotOptions) -> None:
        self.suite, self.task_id, self.num_envs, self.options = suite, task, num_envs, options
        info: Any = vecenv.list_tasks(suite)[task]
        self._name, self._instruction = str(info.name), str(info.instruction)
        self._fields = options.of_suite(suite)
        config: Any = vecenv.make_config(suite, self._fields)
        self._episodes = num_episodes(suite, config.protocol)[task]
        self._budget = self._budget_of(config, info)
        fps = 20 if vecenv.family(suite) == protocols.LIBERO else round(info.robot.control_hz)
        self.render_mode = "rgb_array"
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": fps,
            "autoreset_mode": AutoresetMode.DISABLED,
        }
        self.single_action_space = spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
        self.single_observation_space = self._space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._batch: Batch | None = None
        self._next, self._seed = np.arange(num_envs), None
        self._images: Mapping[str, np.ndarray] = {}

    def _budget_of(self, config: Any, task: Any) -> int:
        if vecenv.family(self.suite) == protocols.LIBERO:
            return int(config.rules(self.suite).max_steps)
        return int(config.max_steps or task.max_steps)

    def _space(self) -> spaces.Dict:
        images: dict[str, spaces.Space[Any]] = {
            name: spaces.Box(0, 255, shape, np.uint8) for name, shape in self._image_shapes().items()
        }
        parts: dict[str, spaces.Space] = {"pixels": spaces.Dict(images)}
        if self.options.obs_type == "pixels_agent_pos":
            parts["agent_pos"] = spaces.Box(-np.inf, np.inf, (state_width(self.suite),), np.float32)
        return spaces.Dict(parts)

    def _image_shapes(self) -> dict[str, tuple[int, int, int]]:
        return image_shapes(self.suite, self.options)

    # -- what LeRobot asks sub-environments for ------------------------------------------------------------------------

    def call(self, name: str, *args: object, **kwargs: object) -> tuple[object, ...]:
        """What each sub-environment answers: ``task``, ``task_description``, ``_max_episode_steps``, ``render``.

        Raises:
            AttributeError: another name.
        """
        if name == "render":
            return self.render()
        return self.get_attr(name)

    def get_attr(self, name: str) -> tuple[object, ...]:
        """An attribute of each sub-environment, as for ``call``."""
        known = {
            "task": self._name,
            "task_id": self.task_id,
            "_max_episode_steps": self._budget,
            "render_mode": self.render_mode,
            "metadata": self.metadata,
        }
        if name == "task_description":
            return self._instruction_of_each()
        if name not in known:
            raise AttributeError(f"sub-environments have no attribute {name!r}; they have {', '.join(known)}")
        return (known[name],) * self.num_envs

    def _instruction_of_each(self) -> tuple[str, ...]:
        return (self._instruction,) * self.num_envs if self._batch is None else self._batch.instructions()

    # -- episodes ------------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, object] | None = None
    ) -> tuple[LeRobotObservation, dict[str, Any]]:
        """Begin the next episode in every sub-environment.

        Args:
            seed: what LeRobot seeds sub-environments with; in LIBERO it decides where fixtures stand, the episode's
                init state does not depend on it. None keeps the last.
            options: ignored; LeRobot marks new rollouts with them.
        """
        episodes = self._next % self._episodes
        batch = self._made(episodes, seed)
        batch.set_episodes(episodes=episodes.tolist())
        info = batch.reset()
        self._next += self.num_envs
        return self._observe(batch), self._reset_infos(info)

    def _made(self, episodes: np.ndarray, seed: int | Sequence[int | None] | None) -> Batch:
        """The batch, made anew where there is none or the seed does not continue the last one's sequence."""
        first = seed if seed is None or isinstance(seed, int | np.integer) else seed[0]
        base = self._seed if first is None else max(int(first) - int(episodes[0]), 0)
        if self._batch is None or base != self._seed:
            self.close()
            self._seed = base
            seeded = vecenv.family(self.suite) == protocols.LIBERO and base is not None and "seed" not in self._fields
            fields: dict[str, Any] = {**self._fields, **({"seed": base} if seeded else {})}
            made: Any = vecenv.make(self.suite, tasks=[self.task_id], episodes=episodes.tolist(), **fields)
            self._batch = made
        return self._live()

    def _live(self) -> Batch:
        if self._batch is None:
            raise LeRobotError("call reset() first: it makes the environments")
        return self._batch

    def step(
        self, actions: npt.ArrayLike
    ) -> tuple[LeRobotObservation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One tick of every sub-environment; those whose episode has ended ignore it.

        Args:
            actions: [n, 7], see ``vecenv.contract``.

        Raises:
            LeRobotError: before the first ``reset``.
            ActionError: actions of another shape.
        """
        batch = self._live()
        before = batch.done
        control = batch.step_continuous(actions)
        return (
            self._observe(batch),
            control.reward,
            control.terminated,
            control.truncated,
            self._infos(control, control.done & ~before),
        )

    def _observe(self, batch: Batch) -> LeRobotObservation:
        seen = batch.observe_egocentric()
        cameras = [camera for camera, name in CAMERA_NAMES.items() if name in self._image_shapes()]
        if isinstance(seen.images, Rendered):
            seen.images.prepare(*cameras)
        self._images = {CAMERA_NAMES[camera]: seen.images[camera] for camera in cameras}
        parts: LeRobotObservation = {"pixels": dict(self._images)}
        if self.options.obs_type == "pixels_agent_pos":
            parts["agent_pos"] = seen.state
        return parts

    def _reset_infos(self, info: ResetInfo) -> dict[str, Any]:
        return {
            "is_success": np.zeros(self.num_envs, bool),
            "episode_id": np.array(info.episode_id, object),
            "task_id": info.task_id,
        }

    def _infos(self, control: Control, ended: np.ndarray) -> dict[str, Any]:
        """Infos of a step; of those that ended with it also in ``final_info``."""
        success = control.success & control.done
        infos: dict[str, Any] = {"is_success": success, "fault": np.array(control.info["fault"], object)}
        if ended.any():
            infos |= {"final_info": {"is_success": success & ended, "_is_success": ended}, "_final_info": ended}
        return infos

    def render(self) -> tuple[np.ndarray, ...]:
        """The last observation's first image of each sub-environment, uint8 [H, W, 3]."""
        self._live()
        return tuple(self._images[CAMERA_NAMES["agentview"]])

    def close(self, **kwargs: object) -> None:
        """Release the batch; the next ``reset`` makes another."""
        if self._batch is not None:
            self._batch.close()
        self._batch = None


def make_envs(
    suites: str | Sequence[str],
    *,
    num_envs: int,
    tasks: str | Sequence[int | str] | None = None,
    options: LeRobotOptions | None = None,
) -> dict[str, dict[int, LeRobotVectorEnv]]:
    """Environments of every chosen task of some suites, as LeRobot's ``make_env`` returns them; none is built yet.

    Args:
        suites: one or several, also as a text with commas.
        num_envs: sub-environments of each task.
        tasks: their tasks, as for ``vecenv.make``; None for all.
        options: see ``LeRobotOptions``.

    Raises:
        LeRobotError: no suite, or ``num_envs`` below 1.
        KeyError, PlacementError: subclasses that name the suite or the task that does not exist.
    """
    names = [name.strip() for name in suites.split(",") if name.strip()] if isinstance(suites, str) else list(suites)
    if not names or num_envs < 1:
        raise LeRobotError(f"suites={suites!r}, num_envs={num_envs}: expected a suite and at least 1")
    chosen = options or LeRobotOptions()
    return {
        suite: {
            task: LeRobotVectorEnv(suite, task, num_envs, chosen)
            for task in placement.task_indices(tasks, [each.name for each in vecenv.list_tasks(suite)])
        }
        for suite in names
    }
