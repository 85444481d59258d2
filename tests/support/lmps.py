"""Language programs over a world of voxels, with a model that answers from a table."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from support.llm_server import Answer, LlmServer, code
from voxposer.language.llm import Llm, LlmConfig
from voxposer.language.lmp import Lmps
from voxposer.language.lmp_config import NAMES, Call
from voxposer.language.observations import Observation

SIZE = 20
OBJECTS = ("bowl_1", "plate_1", "cup_1", "cup_2")
PROMPTS = {name: f"# Query: an example for {name}.\npass" for name in NAMES}


QUESTION = ({"role": "user", "content": "# Query: grasp the bowl."},)


class Model(Llm):
    """A model that notes its pauses in place of waiting."""

    def __init__(self, config: LlmConfig) -> None:
        self.pauses: list[float] = []
        super().__init__(config, sleep=self.pauses.append)


class World:
    """Things at voxels, one centimetre a voxel, and what was done."""

    def __init__(self) -> None:
        self.positions = {"bowl_1": [5, 6, 7], "plate_1": [10, 12, 2], "cup_1": [3, 3, 3], "cup_2": [4, 15, 3]}
        self.positions["gripper"] = [9, 9, 15]
        self.done: list[tuple[Any, ...]] = []

    def detect(self, name: str) -> Observation:
        position = np.array(self.positions[name])
        aabb = np.stack([position - 1, position + 1])
        return Observation(
            {"name": name, "position": position, "aabb": aabb, "normal": np.array([0.0, 0.0, 1.0]), "_points": [1]}
        )

    def execute(self, movable: Any, affordance_map: Any = None, **maps: Any) -> None:
        given = {"affordance_map": affordance_map, **maps}
        evaluated = {name: value() for name, value in given.items() if value is not None}
        self.done.append((movable()["name"], evaluated))

    def set_voxel_by_radius(self, voxel_map: np.ndarray, xyz: Any, radius_cm: float = 0, value: Any = 1) -> np.ndarray:
        low, high = (np.clip(np.asarray(xyz) + sign * int(radius_cm), 0, SIZE - 1) for sign in (-1, 1))
        voxel_map[low[0] : high[0] + 1, low[1] : high[1] + 1, low[2] : high[2] + 1] = value
        return voxel_map

    def cm2index(self, cm: float, direction: Any) -> Any:
        return int(cm) if isinstance(direction, str) else np.round(cm * direction).astype(int)

    def functions(self) -> dict[str, Callable[..., Any]]:
        return {
            "detect": self.detect,
            "execute": self.execute,
            "reset_to_default_pose": lambda: self.done.append(("reset",)),
            "set_voxel_by_radius": self.set_voxel_by_radius,
            "cm2index": self.cm2index,
            "vec2quat": lambda vector: np.array([0.0, *vector]),
            "get_empty_affordance_map": lambda: np.zeros((SIZE,) * 3),
            "get_empty_avoidance_map": lambda: np.zeros((SIZE,) * 3),
            "get_empty_velocity_map": lambda: np.ones((SIZE,) * 3),
            "get_empty_gripper_map": lambda: np.ones((SIZE,) * 3),
            "get_empty_rotation_map": lambda: np.tile([1.0, 0, 0, 0], (SIZE,) * 3 + (1,)),
        }


class Setup:
    """Language programs whose model answers from a table: (LMP, query) -> reply."""

    def __init__(self, server: LlmServer, answers: Mapping[tuple[str, str], str | Answer], **options: Any) -> None:
        self.server, self.answers, self.world = server, dict(answers), World()
        server.requests.clear()
        server.answer = self._answer
        self.llm = Llm(LlmConfig(model="openai/local", api_base=server.base, api_key="k", cache=False, attempts=1))
        self.lmps = Lmps(self.world.functions(), self.llm, PROMPTS, **options)
        self.lmps.set_context(OBJECTS)

    def _answer(self, request: Mapping[str, Any]) -> Answer:
        found = self.answers[asked_of(request), asked(request)]
        return code(found) if isinstance(found, str) else found


def asked_of(request: Mapping[str, Any]) -> str:
    (name,) = re.findall(r"Queries are for `(\w+)`", request["messages"][1]["content"])
    return name


def asked(request: Mapping[str, Any]) -> str:
    return request["messages"][-1]["content"].splitlines()[-1].removeprefix("# Query: ").removesuffix(".")


Answers = Mapping[tuple[str, str], str | Answer]


FINDS: Answers = {
    ("parse_query_obj", "gripper"): "ret_val = detect('gripper')",
    ("parse_query_obj", "bowl"): "bowl = detect('bowl_1')\nret_val = bowl",
    ("parse_query_obj", "cups"): "ret_val = [detect(name) for name in objects if 'cup' in name]",
}
ABOVE = """affordance_map = get_empty_affordance_map()
bowl = parse_query_obj('bowl')
(min_x, min_y, min_z), (max_x, max_y, max_z) = bowl.aabb
center_x, center_y, center_z = bowl.position
affordance_map[center_x, center_y, max_z + cm2index(5, 'z')] = 1
ret_val = affordance_map"""


def call_of(lmps: Lmps, name: str) -> Call:
    """The only question to an LMP."""
    (call,) = [call for call in lmps.trace if call.lmp == name]
    return call
