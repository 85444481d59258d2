"""VoxPoser with one part replaced: what the ablation and the clutter benchmark compare.

:data:`VARIANTS` has, by name, the options of the policy that a variant sets (``voxposer.settings.Settings``) and a
sentence about it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Variant:
    """One variant: a sentence about it, and options of the policy."""

    about: str
    options: Mapping[str, str]


VARIANTS: Mapping[str, Variant] = {
    "map": Variant(
        "the default: configuration-space maps, and the planner's path followed as it is", {"route.mode": "map"}
    ),
    "raised": Variant("the hand rerouted over surface points", {"route.mode": "raised"}),
    "raised-straight": Variant(
        "the same with straight lines in place of the planner", {"route.mode": "raised", "planner.method": "straight"}
    ),
    "planned": Variant("upstream's maps, and the planner's path followed as it is", {"route.mode": "planned"}),
    "straight": Variant(
        "straight lines in place of the planner, followed as they are",
        {"route.mode": "planned", "planner.method": "straight"},
    ),
    "centroid": Variant(
        "rerouted, without grasp and place fields: centroids", {"route.mode": "raised", "perception.fields": "centroid"}
    ),
    "camera": Variant("the default on depth images of two cameras, no ground truth", {"perception": "camera"}),
}
