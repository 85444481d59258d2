"""Tools of environments: what they do to an episode, what they return, and what they refuse."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.node_calls import BUDGET, SMALL, STAY, SUITE, Caller

import vecenv
from vecenv.interop.nodes import (
    EnvLiberoNodeSet,
    NodeError,
    snapshot_from_dict,
    snapshot_to_dict,
)
from vecenv.interop.nodes.texts import read_chunk, read_ee_pose

# -- episodes ----------------------------------------------------------------------------------------------------------


def test_without_an_episode_tools_say_so_and_place_none() -> None:
    nodes = EnvLiberoNodeSet((SUITE,))
    call = Caller(nodes)
    for verb in ("observe_egocentric", "observe_objects", "evaluate", "reset_to_home", "close_gripper"):
        assert "run env_libero__reset" in call(verb)["error"]
    failed = call("step_continuous", STAY)
    assert failed["info"]["error"] == failed["error"] != ""
    assert (failed["reward"], failed["terminated"], failed["truncated"]) == (0.0, False, False)
    assert nodes.manager.episode is None
    nodes.shutdown()


def test_reset_leaves_a_live_episode_alone_and_begins_a_finished_one_again(call: Caller) -> None:
    first = call("reset")
    assert first["episode_id"] == f"{SUITE}/0/0"
    assert (first["suite"], first["task_id"], first["max_steps"]) == (SUITE, 0, BUDGET)
    start = call("observe_egocentric", **SMALL)["state"]
    assert call("step_continuous", [STAY] * 3)["step_index"] == 3
    assert call("reset") == first
    assert call("evaluate")["metrics"]["num_steps"] == 3
    ended = call("step_continuous", [STAY] * (BUDGET + 5))
    assert (ended["truncated"], ended["terminated"], ended["step_index"]) == (True, False, BUDGET)
    assert call("reset") == first
    assert call("evaluate")["metrics"]["num_steps"] == 0
    np.testing.assert_array_equal(call("observe_egocentric", **SMALL)["state"], start)


def test_observations_of_a_finished_episode_are_its_last_and_change_nothing(call: Caller) -> None:
    call("step_continuous", [[1, 0, 0, 0, 0, 0, -1]] * 5)
    last = call("step_continuous", [STAY] * BUDGET)
    assert last["truncated"]
    looks = [call("observe_egocentric", **SMALL) for _ in range(2)]
    objects = [call("observe_objects")["snapshot"] for _ in range(2)]
    np.testing.assert_array_equal(looks[0]["state"], looks[1]["state"])
    np.testing.assert_array_equal(looks[0]["rgb"], looks[1]["rgb"])
    np.testing.assert_array_equal(objects[0]["ee_pose"], last_pose := objects[1]["ee_pose"])
    np.testing.assert_allclose(looks[0]["state"][:3], last_pose[:3], atol=1e-3)
    assert call("evaluate")["metrics"]["num_steps"] == BUDGET
    after = call("step_continuous", STAY)
    assert (after["reward"], after["truncated"], after["step_index"]) == (0.0, True, BUDGET)


def test_the_tools_take_the_ticks_of_the_environment_itself(call: Caller) -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 7))
    with vecenv.make(SUITE, task=0, episodes=[0], max_steps=BUDGET) as env:
        env.reset()
        env.step_continuous(actions[None])
        expected = env.observe_egocentric().state[0]
    for action in actions:
        signals = call("step_continuous", action.tolist())
        call("observe_egocentric", **SMALL)
        call("observe_objects")
        call("step_ee_pose", "[]")
    assert signals["step_index"] == 20
    np.testing.assert_array_equal(call("observe_egocentric", **SMALL)["state"], expected)


# -- actions -----------------------------------------------------------------------------------------------------------


def test_a_chunk_is_cut_and_what_is_not_finite_is_replaced(call: Caller) -> None:
    assert call("step_continuous", [STAY] * 9, max_chunk_steps=4)["step_index"] == 4
    assert call("step_continuous", [STAY] * 2, max_chunk_steps=0)["info"]["ticks"] == 2
    odd = call("step_continuous", "[NaN, Infinity, -Infinity, 5, 0, 0, 1e999]")
    assert odd["error"] == ""
    assert odd["info"]["sanitized"] is True
    assert call("step_continuous", "[]")["info"]["ticks"] == 0


def test_a_pose_is_reached_held_and_nothing_is_a_no_op(call: Caller) -> None:
    here = call("step_ee_pose", "[]")
    assert (here["error"], here["step_count"], here["step_index"]) == ("", 0, 0)
    there = here["final_pose"] + [0.05, 0, 0, 0, 0, 0, 0]
    moved = call("step_ee_pose", [*there, 0])
    assert moved["converged"]
    assert np.linalg.norm(moved["final_pose"][:3] - there[:3]) < 0.01
    held = call("step_ee_pose", {"pose": [*there, 1.0], "hold_steps": 60})
    assert held["step_count"] == 60
    fingers = call("observe_objects")["snapshot"]["gripper"]
    assert np.abs(fingers).sum() < 0.002
    assert json.dumps(held["info"])


def test_limits_of_a_call_are_those_of_its_options(call: Caller, libero: EnvLiberoNodeSet) -> None:
    there = [*(call("step_ee_pose", "[]")["final_pose"] + [0.1, 0, 0, 0, 0, 0, 0]), 0]
    short = call("step_ee_pose", there, max_steps=3)
    assert (short["step_count"], short["converged"]) == (3, False)
    assert call("step_ee_pose", there, pos_tol_m=1.0, rot_tol_rad=3.0)["step_count"] == 1
    near = call("step_ee_pose", there, pos_tol_m=0.002)
    assert np.linalg.norm(near["final_pose"][:3] - there[:3]) <= 0.002
    waypoint = libero.manager.run(lambda env, _: env.config.waypoint)  # pyright: ignore[reportAttributeAccessIssue]
    assert (waypoint.max_steps, waypoint.pos_tol, waypoint.rot_tol) == (100, 0.01, 0.10)


def test_the_hand_returns_home_with_its_fingers_as_they_are(call: Caller) -> None:
    home = call("step_ee_pose", "[]")["final_pose"]
    call("step_ee_pose", [*(home + [0.06, 0.04, -0.05, 0, 0, 0, 0]), 0])
    closed = call("close_gripper")
    assert closed["step_count"] == 60
    back = call("reset_to_home")
    assert back["converged"]
    assert np.linalg.norm(back["final_pose"][:3] - home[:3]) < 0.01
    assert np.abs(call("observe_objects")["snapshot"]["gripper"]).sum() < 0.002


HOSTILE = [
    "",
    "null",
    "true",
    "7",
    "{}",
    '"[1,2,3,4,5,6,7]"',
    "[1, 2",
    "[[]]",
    "[true, 0, 0, 0, 0, 0, 0]",
    "[" * 100_000,
    "[" * 5000 + "]" * 5000,
    "[" + "9" * 4000 + ",0,0,0,0,0,0]",
    "[" + "9" * 5000 + "]",
    '{"pose": [0, 0, 1, 1, 0, 0, 0, 1], "extra": 1}',
    '{"pose": [0, 0, 1, 1, 0, 0, 0, 1], "hold_steps": -1}',
    '{"pose": [0, 0, 1, 1, 0, 0, 0, 1], "hold_steps": 1e3}',
    '{"pose": [0, 0, 1, 1, 0, 0, 0, 1], "hold_steps": true}',
    '{"pose": [0, 0, 1, 1, 0, 0, 0, 1], "carry": 1}',
    '{"hold_steps": 5}',
    '{"pose": {"pose": []}}',
    "[NaN, 0, 0, 1, 0, 0, 0, 1]",
    "[0, 0, 1, 0, 0, 0, 0, 1]",
    "[[0,0,0,0,0,0,0],[0,0,0]]",
    "\x00\ud800",
]


@pytest.mark.parametrize("text", HOSTILE, ids=lambda text: repr(text[:24]))
def test_what_is_no_action_is_a_text_and_moves_nothing(call: Caller, text: str) -> None:
    for verb in ("step_continuous", "step_ee_pose"):
        outputs = call(verb, text)
        assert outputs["error"]
        assert len(outputs["error"]) < 700
        assert outputs["step_index"] == 0


NESTED = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.sampled_from(["pose", "hold_steps", "x"]), inner),
    max_leaves=12,
)


@given(st.text(max_size=40) | NESTED.map(json.dumps))
def test_whatever_the_text_is_it_is_read_or_refused(text: str) -> None:
    for read in (read_chunk, read_ee_pose):
        with contextlib.suppress(NodeError):
            read(text)


@given(inputs=NESTED | st.dictionaries(st.sampled_from(["action", "trigger"]), NESTED), config=NESTED)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_tool_raises_whatever_it_is_given(libero: EnvLiberoNodeSet, inputs: Any, config: Any) -> None:
    for tool in libero.get_tools():
        outputs = tool.run(inputs, config)
        assert isinstance(outputs["error"], str)
        assert set(outputs) == {port.name for port in tool.outputs}


@pytest.mark.parametrize(
    ("inputs", "config", "message"),
    [
        ({}, {}, "input 'action' is missing: it carries TEXT"),
        ({"action": [0] * 7}, {}, "input 'action': got a list; expected text"),
        ({"action": "[]", "pose": 1}, {}, "input 'pose' does not exist; inputs: action"),
        ({"action": "[]"}, {"max_steps": 0}, "config.max_steps: Input should be greater than or equal to 1"),
        ({"action": "[]"}, {"max_steps": "100"}, "config.max_steps: Input should be a valid integer"),
        ({"action": "[]"}, {"pos_tol_m": float("nan")}, "config.pos_tol_m: Input should be a finite number"),
        ({"action": "[]"}, {"tol": 1}, "config.tol does not exist; options: max_steps, pos_tol_m, rot_tol_rad"),
        ({"action": "[]"}, [1], "config: got a list; expected a mapping from options to values"),
        ("[]", {}, "inputs: got a str; expected a mapping from ports to values"),
        ({"action": "[\ud800]"}, {}, "input 'action': the text holds half a surrogate pair"),
        ({"action": "x" * 1_000_001}, {}, "input 'action': 1,000,001 characters; at most 1,000,000 are read"),
    ],
)
def test_wrong_ports_and_options_are_named(call: Caller, inputs: Any, config: Any, message: str) -> None:
    assert message in call.nodes.tools["env_libero__step_ee_pose"].run(inputs, config)["error"]


# -- perception --------------------------------------------------------------------------------------------------------


def test_images_have_the_size_and_ports_that_were_asked_for(call: Caller) -> None:
    plain = call("observe_egocentric")
    assert plain["rgb"].shape == plain["wrist_image"].shape == (256, 256, 3)
    assert plain["rgb"].dtype == np.uint8
    assert plain["depth"] is plain["intrinsics"] is plain["pose"] is None
    for image, shown in zip(plain["observation"], (plain["rgb"], plain["wrist_image"]), strict=True):
        assert image is shown
    np.testing.assert_array_equal(plain["agentview_image"], plain["rgb"])
    small = call("observe_egocentric", resolution=64, depth=True)
    assert small["rgb"].shape == (64, 64, 3)
    assert small["depth"].shape == (64, 64)
    assert small["intrinsics"].shape == (3, 3)
    blocks = plain["rgb"].reshape(64, 4, 64, 4, 3).mean(axis=(1, 3))
    assert np.abs(blocks - small["rgb"]).mean() < 6
    np.testing.assert_array_equal(call("observe_egocentric")["rgb"], plain["rgb"])


def test_a_snapshot_survives_the_wire(call: Caller) -> None:
    call.nodes.panel.set_field("suite", "libero_goal")  # pyright: ignore[reportOptionalMemberAccess]
    seen = call("observe_objects")["snapshot"]
    with vecenv.make("libero_goal", task=0, episodes=[0]) as env:
        env.reset()
        (expected,) = env.observe_objects().snapshot
    assert expected is not None
    through = snapshot_from_dict(json.loads(json.dumps(seen, default=np.ndarray.tolist)))
    equal(snapshot_to_dict(through), snapshot_to_dict(expected))
    assert through.parts
    assert through.panda_base is not None
    boxes = call("observe_objects", points="aabb")["snapshot"]
    name = seen["movable"][0]
    assert boxes["objects"][name]["points"].shape != seen["objects"][name]["points"].shape


def equal(ours: Any, theirs: Any) -> None:
    if isinstance(theirs, Mapping):
        assert set(ours) == set(theirs)
        for name in theirs:
            equal(ours[name], theirs[name])
    else:
        np.testing.assert_array_equal(ours, theirs)


def test_what_is_no_snapshot_is_refused_by_name(call: Caller) -> None:
    seen = call("observe_objects")["snapshot"]
    name = seen["names"][0]
    cloud = {"points": [[0, 0, 0]], "normals": []}
    for changes, message in (
        ({"ee_pose": [1, 2]}, r"ee_pose has shape \[2\]; expected \[7\]"),
        ({"gripper": [float("nan"), 0]}, "gripper is not finite"),
        ({"objects": {name: cloud}}, rf"objects.{name} has 1 points and 0 normals"),
        ({"names": "bowl"}, "names is a str; expected a list"),
        ({"workspace": [[0], [1, 2]]}, "workspace is ragged"),
        ({"more": 1}, "'more' does not exist"),
        ({"parts": {"p": {"parent": "x"}}}, "parts.p.kind is a NoneType; expected text"),
    ):
        with pytest.raises(NodeError, match=message):
            snapshot_from_dict({**seen, **changes})
    with pytest.raises(NodeError, match="'objects' is missing"):
        snapshot_from_dict({key: value for key, value in seen.items() if key != "objects"})
    with pytest.raises(NodeError, match="a list; expected a mapping"):
        snapshot_from_dict([])
