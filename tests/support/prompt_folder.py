"""A folder of prompts in the layout of VoxPoser's own (huangwl18/VoxPoser, ``src/prompts/rlbench``), in other words.

The same file names and conventions: imports at the top, ``objects = [...]`` lines, ``# Query: ...`` examples that end
in ``# done`` or in an assignment to ``ret_val``, and one example that leaves the assignment out. :class:`Copyist` is a
model that has nothing but such a folder: it answers a query with the example of that query in the prompt that it is
shown.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from support.scripted import ScriptedLlm
from voxposer.language.replies import LlmError, Message, Reply

FILES = {
    "planner": """import numpy as np
from env_utils import execute
from perception_utils import parse_query_obj
import action_utils

objects = ['wooden_cabinet_1', 'wooden_cabinet_1_top_handle', 'butter_1']
# Query: close the top drawer of the cabinet.
composer("push the handle of the top drawer in by 20cm")
# done

objects = ['alphabet_soup_1', 'basket_1', 'milk_1']
# Query: pick up the alphabet soup and place it in the basket.
composer("take hold of the soup can")
composer("lift the hand by 20cm")
composer("bring it over the basket")
composer("let go")
composer("return to where you started")
# done

objects = ['spoon', 'towel']
# Query: put the spoon on the towel.
composer("take hold of the spoon")
composer("lift the hand by 10cm, slowly at first")
composer("bring it over the towel")
composer("let go")
composer("return to where you started")
# done
""",
    "composer": """import numpy as np
from env_utils import execute, reset_to_default_pose
from perception_utils import parse_query_obj
from plan_utils import get_affordance_map, get_avoidance_map, get_velocity_map, get_rotation_map, get_gripper_map

# Query: push the handle of the top drawer in by 20cm.
movable = parse_query_obj('handle of the top drawer')
affordance_map = get_affordance_map('20cm into the handle of the top drawer')
execute(movable, affordance_map=affordance_map)

# Query: take hold of the soup can.
movable = parse_query_obj('gripper')
affordance_map = get_affordance_map('the middle of the soup can')
gripper_map = get_gripper_map('open except around the soup can')
rotation_map = get_rotation_map('point at the table')
execute(movable, affordance_map=affordance_map, gripper_map=gripper_map, rotation_map=rotation_map)

# Query: take hold of the spoon.
movable = parse_query_obj('gripper')
affordance_map = get_affordance_map('the middle of the spoon')
velocity_map = get_velocity_map('half the speed near the spoon')
gripper_map = get_gripper_map('open except around the spoon')
execute(movable, affordance_map=affordance_map, velocity_map=velocity_map, gripper_map=gripper_map)

# Query: lift the hand by 20cm.
movable = parse_query_obj('gripper')
affordance_map = get_affordance_map(f'20cm above {movable.position}')
execute(movable, affordance_map=affordance_map)

# Query: lift the hand by 10cm, slowly at first.
movable = parse_query_obj('gripper')
affordance_map = get_affordance_map(f'10cm above {movable.position}')
velocity_map = get_velocity_map('half the speed near the spoon')
execute(movable, affordance_map=affordance_map, velocity_map=velocity_map)

# Query: bring it over the basket.
movable = parse_query_obj('gripper')
affordance_map = get_affordance_map('15cm over the basket')
avoidance_map = get_avoidance_map('8cm from the milk')
execute(movable, affordance_map=affordance_map, avoidance_map=avoidance_map)

# Query: bring it over the towel.
movable = parse_query_obj('gripper')
affordance_map = get_affordance_map('5cm over the towel')
execute(movable, affordance_map=affordance_map)

# Query: let go.
movable = parse_query_obj('gripper')
gripper_map = get_gripper_map('open wherever it is')
execute(movable, gripper_map=gripper_map)

# Query: return to where you started.
reset_to_default_pose()
""",
    "parse_query_obj": """import numpy as np
from perception_utils import detect

objects = ['butter_1', 'wooden_cabinet_1']
# Query: gripper.
gripper = detect('gripper')
ret_val = gripper

objects = ['drawer_1_top_handle', 'drawer_1_low_handle', 'egg_1']
# Query: handle of the top drawer.
handles = [detect(name) for name in objects if name.endswith('handle')]
heights = [handle.position[2] for handle in handles]
ret_val = handles[int(np.argmax(heights))]

objects = ['alphabet_soup_1', 'tomato_sauce_1']
# Query: soup can.
for name in objects:
    if 'soup' in name:
        can = detect(name)
        break
ret_val = can

objects = ['basket_1', 'milk_1']
# Query: basket.
basket = detect('basket_1')
ret_val = basket

objects = ['milk_1', 'butter_1']
# Query: anything tall.
tall = []
for name in objects:
    thing = detect(name)
    (_, _, bottom), (_, _, top) = thing.aabb
    if top - bottom > 8 and name.startswith(('milk', 'orange')):
        tall.append(thing)
ret_val = tall

objects = ['spoon', 'towel']
# Query: spoon.
ret_val = detect('spoon')

objects = ['spoon', 'towel']
# Query: towel.
towel = detect('towel')
ret_val = towel

objects = ['spoon']
# Query: fork.
ret_val = None
""",
    "get_affordance_map": """import numpy as np
from perception_utils import parse_query_obj
from plan_utils import get_empty_affordance_map, set_voxel_by_radius, cm2index

# Query: 20cm into the handle of the top drawer.
affordance_map = get_empty_affordance_map()
handle = parse_query_obj('handle of the top drawer')
# into: against the normal
inwards = -handle.normal
x, y, z = handle.position + cm2index(20, inwards)
affordance_map[x, y, z] = 1
ret_val = affordance_map

# Query: 20cm above {position}.
affordance_map = get_empty_affordance_map()
x, y, z = {numbers}
affordance_map[x, y, z + cm2index(20, 'z')] = 1
ret_val = affordance_map

# Query: 10cm above {position}.
affordance_map = get_empty_affordance_map()
x, y, z = {numbers}
affordance_map[x, y, z + cm2index(10, 'z')] = 1
ret_val = affordance_map

# Query: the middle of the soup can.
affordance_map = get_empty_affordance_map()
can = parse_query_obj('soup can')
x, y, z = can.position
affordance_map[x, y, z] = 1
ret_val = affordance_map

# Query: the middle of the spoon.
affordance_map = get_empty_affordance_map()
spoon = parse_query_obj('spoon')
set_voxel_by_radius(affordance_map, spoon.position, radius_cm=0, value=1)

# Query: 15cm over the basket.
affordance_map = get_empty_affordance_map()
basket = parse_query_obj('basket')
(min_x, min_y, min_z), (max_x, max_y, max_z) = basket.aabb
center_x, center_y, center_z = basket.position
z = max_z + cm2index(15, 'z')
affordance_map[(min_x + max_x) / 2, (min_y + max_y) / 2, z] = 1
ret_val = affordance_map

# Query: 5cm over the towel.
affordance_map = get_empty_affordance_map()
towel = parse_query_obj('towel')
(min_x, min_y, min_z), (max_x, max_y, max_z) = towel.aabb
center_x, center_y, center_z = towel.position
affordance_map[center_x, center_y, max_z + cm2index(5, 'z')] = 1
ret_val = affordance_map
""",
    "get_avoidance_map": """import numpy as np
from perception_utils import parse_query_obj
from plan_utils import get_empty_avoidance_map, set_voxel_by_radius, cm2index

# Query: 8cm from the milk.
avoidance_map = get_empty_avoidance_map()
for thing in parse_query_obj('anything tall'):
    set_voxel_by_radius(avoidance_map, thing.position, radius_cm=8, value=1)
ret_val = avoidance_map
""",
    "get_gripper_map": """import numpy as np
from perception_utils import parse_query_obj
from plan_utils import get_empty_gripper_map, set_voxel_by_radius, cm2index

# Query: open except around the soup can.
gripper_map = get_empty_gripper_map()
gripper_map[:, :, :] = 1
can = parse_query_obj('soup can')
set_voxel_by_radius(gripper_map, can.position, radius_cm=1, value=0)
ret_val = gripper_map

# Query: open except around the spoon.
gripper_map = get_empty_gripper_map()
gripper_map[:] = 1
spoon = parse_query_obj('spoon')
set_voxel_by_radius(gripper_map, spoon.position, radius_cm=1, value=0)
ret_val = gripper_map

# Query: open wherever it is.
gripper_map = get_empty_gripper_map()
gripper_map[:, :, :] = 1
ret_val = gripper_map
""",
    "get_rotation_map": """import numpy as np
from plan_utils import get_empty_rotation_map, set_voxel_by_radius, cm2index, vec2quat
from perception_utils import parse_query_obj
from transforms3d.euler import euler2quat, quat2euler
from transforms3d.quaternions import qmult, qinverse

# Query: point at the table.
rotation_map = get_empty_rotation_map()
now = rotation_map[0, 0, 0]
back_and_forth = qmult(qmult(now, euler2quat(0, 0, np.pi / 8)), qinverse(euler2quat(0, 0, np.pi / 8)))
rotation_map[:, :, :] = back_and_forth
ret_val = rotation_map
""",
    "get_velocity_map": """import numpy as np
from plan_utils import get_empty_velocity_map, set_voxel_by_radius, cm2index
from perception_utils import parse_query_obj

# Query: half the speed near the spoon.
velocity_map = get_empty_velocity_map()
spoon = parse_query_obj('spoon')
set_voxel_by_radius(velocity_map, spoon.position, radius_cm=5, value=0.5)
ret_val = velocity_map
""",
}


def write(folder: Path) -> Path:
    """The folder, with the files in it under upstream's names."""
    folder.mkdir()
    for name, text in FILES.items():
        (folder / f"{name}_prompt.txt").write_text(text, encoding="utf-8")
    return folder


class Copyist(ScriptedLlm):
    """A model that answers with the example of the same query, taken from the prompt that it is shown.

    Where an example's query has ``{position}`` in it, it stands for a position such as ``[10 20 30]``, and
    ``{numbers}`` in the program for its numbers.
    """

    def __init__(self) -> None:
        super().__init__({})

    def complete(self, messages: Sequence[Message], **options: Any) -> Reply:
        """The program of the example."""
        prompt = messages[1]["content"].split("```")[1]
        query = messages[-1]["content"].splitlines()[-1].removeprefix("# Query: ").removesuffix(".")
        (name,) = re.findall(r"Queries are for `(\w+)`", messages[1]["content"])
        numbers = re.search(r"\[([\d ]+)\]", query)
        wanted = query if numbers is None else query.replace(numbers[0], "{position}")
        self.asked.append((name, query))
        for example in re.split(r"^# Query: ", prompt, flags=re.MULTILINE)[1:]:
            asked, _, program = example.partition("\n")
            if asked.removesuffix(".") == wanted:
                text = re.split(r"^objects = ", program, flags=re.MULTILINE)[0].strip()
                text = text if numbers is None else text.replace("{numbers}", ", ".join(numbers[1].split()))
                tokens = {"prompt_tokens": 0, "completion_tokens": 0, "cost_usd": 0.0}
                return Reply(text=text, model="copyist", finish_reason="stop", **tokens)
        raise LlmError("copyist", f"the prompt of {name} has no example of {query!r}")
