"""Options of planning an episode (``voxposer.runtime``), and the budgets of the loops around it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from vecenv.errors import InvalidInput
from vecenv.manipulation.routes import RouteConfig
from voxposer.episode import MAX_SUBTASKS, MAX_WAYPOINTS
from voxposer.language.lmp_config import CONFIGS, LmpConfig
from voxposer.perception.config import PerceptionConfig
from voxposer.planning.config import PlannerConfig
from voxposer.planning.plan import PlanConfig
from voxposer.pushing import PushingConfig
from voxposer.sandbox.guard import Limits


@dataclass(frozen=True, kw_only=True)
class RuntimeConfig:
    """Options of planning, and the budgets of the loops around it.

    Attributes:
        perception: how objects are seen.
        route: distances that the hand keeps from the scene.
        plan: how stops become waypoints.
        planner: of paths over voxels.
        push: how objects are pushed.
        limits: what a program may use.
        lmps: the language programs, by name.
        repairs: how often the model is shown what a program of its did wrong, and asked for another; 0 for never.
        max_subtasks: how often a subtask is planned and followed in an episode; None for no limit.
        max_waypoints: waypoints that are followed of a trajectory; None for no limit.
        num_waypoints_per_plan: stops that are kept of a planned motion, the first ones.
        max_plan_iter: how often a motion of the hand is planned, each time on a fresh snapshot, until the hand is
            within two voxels of its targets. Its maps stay those of the first time.
    """

    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    route: RouteConfig = field(default_factory=RouteConfig)
    plan: PlanConfig = field(default_factory=PlanConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    push: PushingConfig = field(default_factory=PushingConfig)
    limits: Limits = field(default_factory=Limits)
    lmps: Mapping[str, LmpConfig] = field(default_factory=lambda: CONFIGS)
    repairs: int = 1
    max_subtasks: int | None = MAX_SUBTASKS
    max_waypoints: int | None = MAX_WAYPOINTS
    num_waypoints_per_plan: int = 10_000
    max_plan_iter: int = 1

    def __post_init__(self) -> None:
        for name in ("max_subtasks", "max_waypoints", "num_waypoints_per_plan", "max_plan_iter"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InvalidInput(f"{name} must be at least 1, got {value}")
