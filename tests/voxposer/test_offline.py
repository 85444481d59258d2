"""The offline writer: what it reads instructions as, which things it means, what it refuses, and its provider."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from support.offline_world import ToyWorld

from vecenv.observations import ObjectsSnapshot, Part, PartJoint, PointCloud
from voxposer.language.observations import DynamicObservations
from voxposer.language.prompts import load_prompts
from voxposer.offline import provider as offline
from voxposer.offline.composer_writer import write_composer
from voxposer.offline.grammar import read_instruction, read_noun
from voxposer.offline.map_writer import write_affordance, write_gripper, write_rotation, write_velocity
from voxposer.offline.names import NotUnderstood, matching, read_names
from voxposer.offline.planner_writer import write_planner

Middles = dict[str, tuple[float, float, float]]


def boxes(middles: Middles) -> dict[str, PointCloud]:
    """Cubes with edges of 6 cm at the given places."""
    corners = np.array([[x, y, z] for x in (-0.03, 0.03) for y in (-0.03, 0.03) for z in (-0.03, 0.03)])
    return {name: PointCloud(corners + middle, np.zeros((8, 3))) for name, middle in middles.items()}


def scene(middles: Middles, parts: dict[str, Part] | None = None) -> ObjectsSnapshot:
    """A table with cubes on it."""
    things = boxes(middles)
    return ObjectsSnapshot(
        names=tuple(things),
        objects=things,
        poses={},
        regions={},
        goal=(),
        scene=PointCloud(np.zeros((0, 3)), np.zeros((0, 3))),
        ee_pose=np.array([-0.2, 0.0, 0.25, 0.0, 1.0, 0.0, 0.0]),
        gripper=np.array([0.04, -0.04]),
        workspace=np.array([[-0.7, -0.4, -0.1], [0.3, 0.5, 0.35]]),
        movable=tuple(things),
        parts=parts or {},
    )


def said(instruction: str) -> list[str]:
    """An instruction as read, one line an action."""
    return [
        f"{action.verb} {action.thing}" + (f" {action.place.relation} {action.place.thing}" if action.place else "")
        for action in read_instruction(instruction)
    ]


# SIMPLER's sentences


@pytest.mark.parametrize(
    ("instruction", "result"),
    [
        ("put the spoon on the towel", [("grasp", "spoon"), ("put", "spoon")]),
        ("put carrot on plate", [("grasp", "carrot"), ("put", "carrot")]),
        ("stack the green block on the yellow block", [("grasp", "green_cube"), ("put", "green_cube")]),
        ("put eggplant into yellow basket", [("grasp", "eggplant"), ("put", "eggplant")]),
        ("pick coke can", [("grasp", "coke_can")]),
        ("move coke can near apple", [("grasp", "coke_can"), ("put", "coke_can")]),
    ],
)
def test_simpler_instructions_move_the_named_object(instruction: str, result: list[tuple[str, str]]) -> None:
    names = (
        "spoon",
        "table_cloth",
        "carrot",
        "plate",
        "green_cube",
        "yellow_cube",
        "eggplant",
        "yellow_basket",
        "coke_can",
        "apple",
    )
    world = ToyWorld(scene({name: (-0.5 + 0.07 * i, 0.1 * (i % 3), 0.0) for i, name in enumerate(names)}))
    assert world.do(instruction).log == result


def test_simpler_near_is_next_to_it_on_the_table() -> None:
    world = ToyWorld(scene({"coke_can": (-0.4, -0.2, 0.0), "apple": (-0.1, 0.2, 0.0)}), size=100).do(
        "move coke can near apple"
    )
    gap = np.linalg.norm((world.bounds("coke_can") - world.bounds("apple")).mean(axis=0)[:2])
    assert 0.06 < gap < 0.13
    assert world.bounds("coke_can")[0, 2] == pytest.approx(-0.03, abs=0.01)


def drawer(parent: str, kind: str, z: float) -> Part:
    joint = PartJoint(kind="slide", axis=np.array([-1.0, 0.0, 0.0]), anchor=np.zeros(3), travel=0.2, opened=0.0)
    return Part(parent=parent, kind=kind, cloud=boxes({"part": (-0.1, 0.0, z)})["part"], joint=joint)


def cabinet() -> ObjectsSnapshot:
    levels = {f"cabinet_{level}_handle": drawer("cabinet", "handle", z) for level, z in (("top", 0.2), ("middle", 0.1))}
    return scene({"cabinet": (0.1, 0.0, 0.1), "apple": (-0.3, 0.3, 0.0)}, levels)


def test_simpler_drawers_open_and_close() -> None:
    world = ToyWorld(cabinet(), size=100)
    world.do("open top drawer")
    assert world.bounds("cabinet_top_handle").mean(axis=0)[0] < -0.26
    assert world.bounds("cabinet_middle_handle").mean(axis=0)[0] == pytest.approx(-0.1)
    world.do("close top drawer")
    assert world.bounds("cabinet_top_handle").mean(axis=0)[0] > -0.12


# Reading


@pytest.mark.parametrize(
    ("instruction", "actions"),
    [
        ("Please put the mug on the plate.", ["put the mug on the plate"]),
        ("can you grab the milk and put it into the basket?", ["put the milk in the basket"]),
        ("take the bowl from the stove and set on plate", ["put the bowl from the stove on the plate"]),
        ("switch stove on and put pan on it", ["turn_on the stove", "put the pan on the stove"]),
        ("turn off the stove", ["turn_off the stove"]),
        ("open the cabinet\u2019s middle drawer", ["open the cabinet middle drawer"]),
        ("open the top drawer and put the bowl inside", ["open the top drawer", "put the bowl in the top drawer"]),
        (
            "put the bowl in the bottom drawer and close it",
            ["put the bowl in the bottom drawer", "close the bottom drawer"],
        ),
        (
            "put both the soup and the butter in the basket",
            ["put the soup in the basket", "put the butter in the basket"],
        ),
        (
            "place white mug on left plate and yellow-white mug on right plate",
            ["put the white mug on the left plate", "put the yellow white mug on the right plate"],
        ),
        (
            "place white mug on plate and chocolate pudding to right",
            ["put the white mug on the plate", "put the chocolate pudding right_of the plate"],
        ),
        ("put the black bowl at the back on the plate", ["put the black bowl at the back on the plate"]),
        (
            "stack the bowl at the front on the bowl in the middle",
            ["put the bowl at the front on the bowl in the middle"],
        ),
        (
            "stack the left bowl on the right bowl and place them in the tray",
            ["put the right bowl in the tray", "put the left bowl on the right bowl"],
        ),
        ("move the plate to the stove's front", ["put the plate front_of the stove"]),
        ("push the plate to the front of the stove", ["push the plate front_of the stove"]),
        ("pick up the butter", ["pick the butter"]),
        ("close the bottom drawer and open the top one", ["close the bottom drawer", "open the top drawer"]),
    ],
)
def test_instructions_are_parsed(instruction: str, actions: list[str]) -> None:
    assert said(instruction) == actions


@pytest.mark.parametrize(
    "phrase",
    [
        "the black bowl between the plate and the ramekin",
        "the black bowl not between the plate and the ramekin",
        "the bowl next to the cookie box",
        "the bowl on top of the cabinet",
        "the bowl at the center of the table",
        "the book in the middle",
        "the can to the right of the sponge",
        "the bowl on the plate on the left",
    ],
)
def test_a_noun_written_out_is_parsed_to_the_same_noun(phrase: str) -> None:
    noun = read_noun(phrase)
    assert str(noun) == phrase
    assert read_noun(str(noun)) == noun


NAMES = """
    akita_black_bowl_1 cookies_1 porcelain_mug_1 white_yellow_mug_1 red_coffee_mug_1 chefmate_8_frypan_1 cream_cheese_1
    alphabet_soup_1 tomato_sauce_1 bbq_sauce_1 white_bottle_1 wine_rack_1 new_salad_dressing_1 wooden_cabinet_1
    wooden_cabinet_1_top_drawer wooden_cabinet_1_top_handle wooden_cabinet_1_top
"""


@pytest.mark.parametrize(
    ("phrase", "names"),
    [
        ("black bowl", ["akita_black_bowl_1"]),
        ("cookie box", ["cookies_1"]),
        ("white mug", ["porcelain_mug_1"]),
        ("yellow and white mug", ["white_yellow_mug_1"]),
        ("red cup", ["red_coffee_mug_1"]),
        ("mugs", ["porcelain_mug_1", "white_yellow_mug_1", "red_coffee_mug_1"]),
        ("frying pan", ["chefmate_8_frypan_1"]),
        ("cream cheese box", ["cream_cheese_1"]),
        ("soup can", ["alphabet_soup_1"]),
        ("sauce", ["tomato_sauce_1", "bbq_sauce_1"]),
        ("barbecue sauce", ["bbq_sauce_1"]),
        ("wine bottle", ["white_bottle_1"]),
        ("salad dressing", ["new_salad_dressing_1"]),
        ("cabinet", ["wooden_cabinet_1"]),
        ("top drawer", ["wooden_cabinet_1_top_drawer"]),
        ("handle of the cabinet", ["wooden_cabinet_1_top_handle"]),
        ("wooden_cabinet_1_top", ["wooden_cabinet_1_top"]),
        ("chilli sauce", []),
        ("blue mug", []),
        ("teapot", []),
    ],
)
def test_phrases_mean_names(phrase: str, names: list[str]) -> None:
    assert [name.text for name in matching(read_noun(phrase).words, read_names(NAMES.split()))] == names


# References


BOWLS = {"bowl_1": (-0.5, -0.2, 0.0), "bowl_2": (-0.2, 0.0, 0.0), "bowl_3": (0.1, 0.3, 0.0)}


@pytest.mark.parametrize(
    ("phrase", "found"),
    [
        ("the left bowl", "bowl_1"),
        ("the bowl on the right", "bowl_3"),
        ("the bowl at the back", "bowl_1"),
        ("the front bowl", "bowl_3"),
        ("the middle bowl", "bowl_2"),
        ("the bowl next to the plate", "bowl_3"),
        ("the bowl between the plate and the mug", "bowl_2"),
        ("the bowl not between the plate and the mug", "bowl_1"),
        ("the bowl to the left of the plate", "bowl_2"),
        ("the bowl behind the mug", "bowl_1"),
        ("the bowl outside the plate", "bowl_1"),
        ("bowl_2", "bowl_2"),
        ("any bowl", "bowl_1"),
        ("held object", "gripper"),
    ],
)
def test_positions_resolve_ambiguous_words(phrase: str, found: str) -> None:
    world = ToyWorld(scene(BOWLS | {"plate_1": (0.1, 0.2, 0.0), "mug_1": (-0.45, -0.1, 0.0)}), size=100)
    thing = world.detected(phrase)
    assert thing["name"] == found


@pytest.mark.parametrize(("phrase", "found"), [("between", "bowl_1"), ("not between", "bowl_2")])
def test_between_is_near_the_line_and_not_only_near_its_middle(phrase: str, found: str) -> None:
    things = {"plate_1": (-0.3, 0.0, 0.0), "mug_1": (0.3, 0.0, 0.0), "bowl_1": (0.22, 0.02, 0.0)}
    world = ToyWorld(scene(things | {"bowl_2": (0.0, 0.15, 0.0)}), size=100)
    assert world.detected(f"the bowl {phrase} the plate and the mug")["name"] == found


def test_on_is_distinguished_from_beside_and_below_by_heights() -> None:
    stacked = ToyWorld(
        scene(
            {
                "bowl_1": (0.1, 0.2, 0.06),
                "bowl_2": (0.1, 0.2, 0.0),
                "bowl_3": (0.1, 0.3, 0.03),
                "box_1": (0.1, 0.2, 0.0),
            }
        )
    )
    assert stacked.detected("the bowl on the box")["name"] == "bowl_1"


def test_several_objects_come_as_a_list() -> None:
    found = ToyWorld(scene(BOWLS)).lmps.parse_query_obj("all bowls")
    assert isinstance(found, DynamicObservations)
    assert [thing["name"] for thing in found] == list(BOWLS)


def test_equal_objects_are_distinguished_after_one_was_moved() -> None:
    """The right bowl goes to the left of everything; then "the left bowl" is still the one that was left before."""
    world = ToyWorld(
        scene({"bowl_1": (-0.2, 0.0, 0.0), "bowl_2": (-0.2, 0.3, 0.0), "tray_1": (-0.2, -0.3, 0.0)}), size=100
    )
    world.do("stack the left bowl on the right bowl and place them in the tray")
    assert world.log == [("grasp", "bowl_2"), ("put", "bowl_2"), ("grasp", "bowl_1"), ("put", "bowl_1")]
    assert world.bounds("bowl_1")[0, 2] > world.bounds("bowl_2")[0, 2] + 0.03


# Subtasks


def test_two_objects_on_one_flat_place_get_a_half_each() -> None:
    names = ["moka_pot_1", "moka_pot_2", "stove_1", "stove_1_burner", "basket_1"]
    program = write_planner("put both moka pots on the stove", names)
    assert re.findall("place it .*?1", program) == [
        "place it on the left side of the stove_1",
        "place it on the right side of the stove_1",
    ]
    assert "side" not in write_planner("put both moka pots in the basket", names)
    assert "side" not in write_planner("put the moka_pot_1 on the stove", names)
    middles = {"pot_1": (-0.5, -0.2, 0.0), "pot_2": (-0.5, 0.2, 0.0), "plate_1": (0.1, 0.1, 0.0)}
    world = ToyWorld(scene(middles), size=100).do("put both pots on the plate")
    assert world.bounds("pot_1").mean(axis=0)[1] == pytest.approx(0.085, abs=0.006)
    assert world.bounds("pot_2").mean(axis=0)[1] == pytest.approx(0.115, abs=0.006)


def test_avoidance_and_speed_apply_to_every_motion() -> None:
    program = write_planner(
        "put the mug on the plate slowly while avoiding the bottle", ["mug_1", "plate_1", "wine_bottle_1"]
    )
    sentence = "grasp the mug_1 while keeping at least 15cm away from the wine_bottle_1, at 0.5x speed"
    assert f'composer("{sentence}")' in program
    assert program.count("at 0.5x speed") == program.count("composer(") - 1
    code = write_composer(sentence)
    assert "get_avoidance_map('15cm from the wine_bottle_1')" in code
    assert "avoidance_map=avoidance_map, velocity_map=velocity_map)" in code


def test_maps_match_their_query() -> None:
    world = ToyWorld(scene({"mug_1": (-0.2, 0.1, 0.0), "wine_bottle_1": (-0.5, 0.1, 0.0)}), size=100)
    assert world.lmps.get_velocity_map("0.5x speed")().max() == 0.5
    near = world.lmps.get_velocity_map("0.5x speed when within 10cm of the mug")()
    assert near[tuple(world.voxel(np.array([-0.2, 0.1, 0.0])))] == 0.5
    assert near[0, 0, 0] == 1
    avoided = world.lmps.get_avoidance_map("10cm from the mug and 5cm from the bottle")()
    assert avoided[tuple(world.voxel(np.array([-0.25, 0.1, 0.0])))] == 1
    assert avoided[tuple(world.voxel(np.array([-0.5, 0.13, 0.0])))] == 1
    assert avoided[tuple(world.voxel(np.array([-0.5, 0.2, 0.0])))] == 0
    grip = world.lmps.get_gripper_map("open everywhere except 1cm around the grasp position of the mug")()
    assert grip[tuple(world.voxel(np.array([-0.2, 0.1, 0.0])))] == 0
    assert (grip == 0).mean() < 1e-4


@pytest.mark.parametrize(
    ("query", "point"),
    [
        ("a point 10cm above the mug", (-0.2, 0.1, 0.13)),
        ("a point 10cm to the left of the mug", (-0.2, -0.03, 0.0)),
        ("a point 10cm to the right of the mug", (-0.2, 0.23, 0.0)),
        ("a point 10cm in front of the mug", (-0.07, 0.1, 0.0)),
        ("a point 10cm behind the mug", (-0.33, 0.1, 0.0)),
        ("a point 10cm above and 5cm to the left of the mug", (-0.2, 0.02, 0.13)),
        ("the center of the mug", (-0.2, 0.1, 0.0)),
    ],
)
def test_directions_are_x_to_the_front_y_to_the_right_z_up(query: str, point: tuple[float, float, float]) -> None:
    world = ToyWorld(scene({"mug_1": (-0.2, 0.1, 0.0)}), size=100)
    (target,) = np.argwhere(world.lmps.get_affordance_map(query)() == 1)
    np.testing.assert_allclose(world.point(target), point, atol=0.02)


# Not understood


@pytest.mark.parametrize(
    ("instruction", "complaint"),
    [
        ("sing a song", "no known verb"),
        ("put the teapot on the plate", "'the teapot' fits none of mug_1, mug_2, plate_1"),
        ("put the mug on the plate", "'the mug' could be any of mug_1, mug_2"),
        ("put the left mug", "the destination of"),
        ("put it on the plate", "the object to put there is missing"),
        ("put the left mug between the plate", "'between' needs two objects"),
        ("open the plate", "no handle to the plate"),
        ("turn on the plate", "no knob to the plate"),
        ("put the left mug next to the teapot", "the teapot"),
        ("", "no known verb"),
    ],
)
def test_the_planner_reports_what_it_does_not_understand(instruction: str, complaint: str) -> None:
    with pytest.raises(NotUnderstood, match=complaint):
        write_planner(instruction, ["mug_1", "mug_2", "plate_1"])


@pytest.mark.parametrize(
    ("write", "query"),
    [
        (write_composer, "dance with the mug_1"),
        (write_affordance, "somewhere nice"),
        (write_rotation, "upside down"),
        (write_velocity, "as fast as light"),
        (write_gripper, "ajar"),
    ],
)
def test_lower_programs_quote_what_they_do_not_understand(write: Any, query: str) -> None:
    with pytest.raises(NotUnderstood, match=f"'{query}' is not among the sentences"):
        write(query)


def test_a_drawer_has_to_be_named() -> None:
    names = ["mug_1", "cabinet_1", *(f"cabinet_1_{level}_drawer" for level in ("top", "bottom"))]
    with pytest.raises(NotUnderstood, match=r"in which drawer\? There are cabinet_1_top_drawer, cabinet_1_bottom"):
        write_planner("put the mug in the cabinet", names)


# The provider


def asked(lmp: str, query: str, objects: list[str] | None = None) -> list[dict[str, str]]:
    """A request as the LMP runtime makes it, told from others by the examples alone."""
    context = f"objects = {objects!r}\n" if objects is not None else ""
    prompt = f"Complete the code.\n```\n{load_prompts()[lmp]}\n```"
    return [{"role": "user", "content": prompt}, {"role": "user", "content": f"{context}# Query: {query}."}]


@pytest.mark.parametrize(
    ("lmp", "query", "program"),
    [
        ("planner", "turn on the stove", 'composer("grasp the stove_1_knob")'),
        ("composer", "open gripper", "get_gripper_map('open everywhere')"),
        ("parse_query_obj", "the stove", "ret_val = detect('stove_1')"),
        ("get_affordance_map", "the grasp position of the mug_1", "mug.grasp_position"),
        ("get_avoidance_map", "10cm from the mug_1", "radius_cm=10"),
        ("get_rotation_map", "the grasp orientation of the mug_1", "mug.grasp_quat"),
        ("get_velocity_map", "0.5x speed", "velocity_map[:, :, :] = 0.5"),
        ("get_gripper_map", "open everywhere", "gripper_map[:, :, :] = 1"),
    ],
)
def test_the_requested_lmp_is_recognised_by_its_examples(lmp: str, query: str, program: str) -> None:
    objects = ["stove_1", "stove_1_knob"] if lmp in {"planner", "parse_query_obj"} else None
    assert program in offline.write(asked(lmp, query, objects))


def test_a_name_in_the_request_takes_precedence_over_examples() -> None:
    messages = [
        {"role": "user", "content": "Queries are for `get_gripper_map`. detect("},
        *asked("planner", "open everywhere")[1:],
    ]
    assert "gripper_map" in offline.write(messages)


def test_content_may_come_in_parts() -> None:
    parts = [{"type": "text", "text": "objects = ['mug_1']\n# Query: the mug."}]
    assert (
        offline.write([*asked("parse_query_obj", "x")[:1], {"role": "user", "content": parts}])
        == "ret_val = detect('mug_1')"
    )


@pytest.mark.parametrize(
    ("messages", "complaint"),
    [
        ([], "no '# Query"),
        ([{"role": "user", "content": "hello"}], "no '# Query"),
        ([{"role": "user", "content": "# Query: open gripper."}], "which LMP"),
        (
            [{"role": "user", "content": "Queries are for `planner`.\nobjects = [1]\n# Query: x."}],
            "not a list of names",
        ),
    ],
)
def test_invalid_requests_are_refused(messages: list[dict[str, str]], complaint: str) -> None:
    with pytest.raises(NotUnderstood, match=complaint):
        offline.write(messages)


def test_replies_end_at_stop_tokens_and_at_the_token_limit() -> None:
    program = offline.write(asked("planner", "pick up the mug", ["mug_1"]))
    assert offline.cut(program, ["# done"]) == (program.removesuffix("# done"), "stop")
    short, why = offline.cut(program, max_tokens=5)
    assert (why, offline.count_tokens(short)) == ("length", 5)
    assert program.startswith(short)
    assert offline.cut(program, ["absent", ""], 10_000) == (program, "stop")


def test_the_same_request_gets_the_same_reply_in_every_process() -> None:
    names = ["porcelain_mug_1", "white_yellow_mug_1", "plate_1", "plate_2"]
    call = f"write_planner('put the white mug on the left plate', {names})"
    code = f"from voxposer.offline.planner_writer import write_planner\nprint({call})"
    replies = {
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            check=True,
            text=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(replies) == 1


@pytest.mark.filterwarnings("ignore:Item .* on TypedDict class:UserWarning")
def test_litellm_gets_programs_tokens_and_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.socket.connect", lambda *_: pytest.fail("the offline writer used the network"))
    offline.register()
    offline.register()
    litellm = pytest.importorskip("litellm")
    assert [entry["provider"] for entry in litellm.custom_provider_map].count("offline") == 1
    messages = asked("planner", "pick up the mug", ["mug_1"])
    reply = litellm.completion(
        model="offline/libero", messages=messages, stop=["# done"], max_tokens=512, temperature=0
    )
    assert reply.choices[0].message.content.startswith('composer("grasp the mug_1")')
    assert "# done" not in reply.choices[0].message.content
    assert reply.usage.completion_tokens == offline.count_tokens(reply.choices[0].message.content)
    assert reply.usage.prompt_tokens > 1000
    assert (
        litellm.completion(model="offline/libero", messages=messages, max_tokens=3).choices[0].finish_reason == "length"
    )
    with pytest.raises(litellm.BadRequestError, match="does not understand: no known verb"):
        litellm.completion(model="offline/libero", messages=asked("planner", "sing", ["mug_1"]))
    with pytest.raises(litellm.NotFoundError, match="only offline/libero"):
        litellm.completion(model="offline/other", messages=messages)
