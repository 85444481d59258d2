"""VoxPoser with one part replaced: the policy behind the ablation and the clutter benchmark.

The name of a variant comes in; a policy of the harness goes out whose options differ from the defaults in public
config fields alone. :data:`VARIANTS` has each variant's changes and a sentence about it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from vecenv_eval.policies.voxposer import VoxPoserPolicy

from voxposer.agent import AgentConfig


@dataclass(frozen=True)
class Variant:
    """One variant: a sentence about it, and the options it changes."""

    about: str
    change: Callable[[AgentConfig], AgentConfig]


def _route(mode: str) -> Callable[[AgentConfig], AgentConfig]:
    return lambda config: replace(config, route=replace(config.route, mode=mode))


def _straight(config: AgentConfig) -> AgentConfig:
    return replace(config, planner=replace(config.planner, method="straight"))


def _centroid(config: AgentConfig) -> AgentConfig:
    return replace(config, perception=replace(config.perception, fields="centroid"))


VARIANTS: Mapping[str, Variant] = {
    "map": Variant(
        "the default: configuration-space maps, and the planner's path followed as it is, route.mode='map'",
        _route("map"),
    ),
    "raised": Variant("the hand rerouted over surface points, route.mode='raised'", _route("raised")),
    "raised-straight": Variant(
        "the same with straight lines in place of the planner, planner.method='straight'",
        lambda config: _straight(_route("raised")(config)),
    ),
    "planned": Variant(
        "upstream's maps, and the planner's path followed as it is, route.mode='planned'", _route("planned")
    ),
    "straight": Variant(
        "straight lines in place of the planner, followed as they are",
        lambda config: _straight(_route("planned")(config)),
    ),
    "centroid": Variant(
        "rerouted, without grasp and place fields: centroids, perception.fields='centroid'",
        lambda config: _centroid(_route("raised")(config)),
    ),
}
# Variants whose option may not exist yet, and the argument of the policy that selects them.
ARGUMENTS: Mapping[str, Mapping[str, str]] = {"camera": {"perception": "camera"}}


def why_missing(name: str) -> str:
    """Why a variant cannot run here, "" if it can."""
    if name in VARIANTS:
        return ""
    taken = inspect.signature(VoxPoserPolicy).parameters
    missing = [argument for argument in ARGUMENTS[name] if argument not in taken]
    return f"VoxPoserPolicy has no option {missing[0]}: this variant is skipped" if missing else ""


class VariantPolicy(VoxPoserPolicy):
    """VoxPoser as one of :data:`VARIANTS`, or with the policy's own options in :data:`ARGUMENTS`.

    Args:
        variant: its name.
    """

    def __init__(self, variant: str = "map") -> None:
        arguments: dict[str, Any] = dict(ARGUMENTS.get(variant, {}))
        super().__init__(**arguments)
        self.name = f"{self.name}, {variant}"
        if variant in VARIANTS:
            self.config = VARIANTS[variant].change(self.config)
