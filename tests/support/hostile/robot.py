"""A robot whose composer runs hostile programs, on real perception, with programs for its maps that are hostile too."""

from __future__ import annotations

import numpy as np

from support.scripted import ScriptedLlm
from support.voxposer_world import HOME, box, snapshot
from voxposer.interface import Interface
from voxposer.language.lmp import Lmps
from voxposer.language.prompts import load_prompts
from voxposer.perception.config import HandState
from voxposer.perception.view import Perception
from voxposer.sandbox.guard import Limits

THINGS = {"cube_1": box((0.02, 0.02, 0.02), (0.2, 0.1, 0.02)), "bowl_1": box((0.05, 0.05, 0.03), (-0.1, 0.1, 0.03))}

# Query -> the program that the model writes for it, whichever language program it is asked of.
NESTED = {
    "gripper": "ret_val = detect('gripper')",
    "cube": "ret_val = detect('cube_1')",
    "both": "ret_val = [detect('cube_1'), detect('bowl_1')]",
    "target": "m = get_empty_affordance_map()\nm[70, 60, 30] = 1\nret_val = m",
    "everywhere": "m = get_empty_affordance_map()\nm[:] = 1\nret_val = m",
    "free": "ret_val = get_empty_avoidance_map()",
    "full": "ret_val = np.indices((100, 100, 100))[0] / 99",
    "turns": "m = get_empty_rotation_map()\nm[:50] = [0, 1, 0, 0]\nret_val = m",
    "slow": "m = get_empty_velocity_map()\nm[:50] = 0.5\nret_val = m",
    "grip": "m = get_empty_gripper_map()\nm[70, 60, 30] = 0\nret_val = m",
    "endless": "while True: pass",
    "greedy": "x = []\nwhile True: x.append(np.zeros(1000000))",
    "wide": "x = [np.zeros(8000000) for i in range(6)]\nret_val = get_empty_avoidance_map()",
    "deeper": "ret_val = parse_query_obj('gripper').position",
    "text": "ret_val = 'a' * 9999",
    "nan": "ret_val = get_empty_avoidance_map() * np.nan",
    "broken": "ret_val = (",
    "nothing": "x = 1",
    "self": "x = [0]\nx.append(x)\nret_val = x",
    "unicorn": "ret_val = detect('unicorn' * 999)",
    "raises": "raise ValueError('a' * 9999)",
    "objects": "objects.append(objects)\nret_val = objects",
    "greedy then fine": "x = [np.zeros(8000000) for i in range(2)]\nret_val = [detect('cube_1')]",
    "many": "ret_val = [detect('cube_1')] * 9999",
    "small": "ret_val = np.ones((5, 5, 5))",
    "long": "ret_val = np.ones((200, 200, 200))",
    "infinite": "m = get_empty_affordance_map()\nm[0, 0, 0] = np.inf\nret_val = m",
    "truth": "m = get_empty_affordance_map()\nm[70, 60, 30] = 1\nret_val = m > 0",
    "integers": "m = get_empty_affordance_map()\nm[70, 60, 30] = 1\nret_val = m.astype(np.int32)",
    "changing": "p = detect('cube_1').position\np[:] = 1\nm = get_empty_affordance_map()\n"
    "m[detect('cube_1').position] = 1\nret_val = m",
    "function": "ret_val = lambda: 1",
    "module": "ret_val = [np]",
    "dots": "ret_val = [...]",
    "generator": "ret_val = (x for x in [1])",
    "fmod": "ret_val = np.full((200, 200, 200), 1e308) % 5e-324",
    "grown": "m = get_empty_affordance_map()\nret_val = np.concatenate(m for i in range(999))",
    "subnormal": "ret_val = get_empty_avoidance_map() + 5e-324",
    "nowhere": "ret_val = get_empty_rotation_map() * 0",
    "tiny turns": "ret_val = get_empty_rotation_map() * 1e-30",
    "standing": "ret_val = get_empty_velocity_map() * 0",
    "fastest": "ret_val = get_empty_velocity_map() * 3e38",
    "backwards": "ret_val = get_empty_velocity_map() * -5e-324 - 1e-40",
    "beyond": "ret_val = get_empty_gripper_map() * -3e38",
    "deep": "def f(n):\n    return f(n - 1) if n else get_empty_affordance_map() + 1\nret_val = f(20)",
}


class Robot:
    """Runs programs as the composer's. What they changed of the robot's own is an error."""

    def __init__(self, limits: Limits) -> None:
        self._limits, self._prompts = limits, load_prompts()

    def run(self, source: str) -> None:
        """Run one on a fresh view of the scene."""
        seen = snapshot(THINGS)
        interface = Interface()
        interface.begin(Perception(seen, HandState(HOME, HOME, False)))
        script = dict.fromkeys(("parse_query_obj", *_MAPS), lambda query: NESTED.get(query, "ret_val = None"))
        llm = ScriptedLlm({**script, "composer": source})
        lmps = Lmps(interface.functions(), llm, self._prompts, limits=self._limits)
        lmps.set_context(tuple(THINGS))
        before = _state(seen)
        try:
            lmps.composer("go")
        finally:
            interface.end()
            assert _state(seen) == before, "a program changed the snapshot"


_MAPS = ("get_affordance_map", "get_avoidance_map", "get_rotation_map", "get_velocity_map", "get_gripper_map")


def _state(seen: object) -> bytes:
    """Every number of a snapshot."""
    from voxposer.perception.observation import _arrays

    return b"".join(np.ascontiguousarray(each).tobytes() for each in _arrays(seen))
