"""LIBERO and SIMPLER on vecenv for LeRobot: importing this registers ``--env.type=vecenv``.

LeRobot imports installed distributions named ``lerobot_env_*`` before it reads its command line, so installing this
one is all there is to do. The environments are ``vecenv.interop.lerobot``'s.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from vecenv.contract import ACTION_DIM
from vecenv.interop.lerobot import (
    LeRobotError,
    LeRobotOptions,
    LeRobotVectorEnv,
    image_shapes,
    make_envs,
    state_width,
)

__all__ = ["VecenvEnv"]

_STATE = "agent_pos"


@EnvConfig.register_subclass("vecenv")
@dataclass
class VecenvEnv(EnvConfig):
    """vecenv's suites as a LeRobot environment.

    Attributes:
        task: a suite, or several of one kind separated by commas: ``libero_object``, ``simpler/bridge``.
        task_ids: indices of its tasks; None for all.
        episode_length: budget of an episode in ticks; None for LeRobot's own (LIBERO) or the task's (SIMPLER).
        obs_type: ``"pixels_agent_pos"`` or ``"pixels"``.
        observation_height, observation_width: of LIBERO's images, pixels.
        backend: which physics, see ``vecenv.make``.
        num_threads: CPU threads of physics; None for one a core.
    """

    task: str | None = "libero_10"
    task_ids: list[int] | None = None
    fps: int = 20
    episode_length: int | None = None
    obs_type: str = "pixels_agent_pos"
    render_mode: str = "rgb_array"
    observation_height: int = 360
    observation_width: int = 360
    backend: str = "native"
    num_threads: int | None = None
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        suites = self._suites()
        shapes = [(image_shapes(suite, self._options()), state_width(suite)) for suite in suites]
        if any(shape != shapes[0] for shape in shapes):
            raise LeRobotError(f"task={self.task!r}: these suites have observations of different shapes")
        images, width = shapes[0]
        self.features = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(ACTION_DIM,))}
        self.features_map = {ACTION: ACTION}
        for name, shape in images.items():
            key = f"{OBS_IMAGES}.{name}"
            self.features[key] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)
            self.features_map[key] = key
        if self.obs_type == "pixels_agent_pos":
            self.features[_STATE] = PolicyFeature(type=FeatureType.STATE, shape=(width,))
            self.features_map[_STATE] = OBS_STATE

    def _suites(self) -> list[str]:
        suites = [name.strip() for name in (self.task or "").split(",") if name.strip()]
        if not suites:
            raise LeRobotError("task: expected a suite, for example libero_object")
        return suites

    def _options(self) -> LeRobotOptions:
        return LeRobotOptions(
            obs_type=self.obs_type,
            height=self.observation_height,
            width=self.observation_width,
            episode_length=self.episode_length,
            fields={"backend": self.backend, "num_threads": self.num_threads},
        )

    @property
    def gym_kwargs(self) -> dict[str, object]:
        """Unused: ``create_envs`` makes the environments."""
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, LeRobotVectorEnv]]:
        """``{suite: {task: environment}}``; one batch has all sub-environments, so ``use_async_envs`` has no effect."""
        return make_envs(self._suites(), num_envs=n_envs, tasks=self.task_ids, options=self._options())
