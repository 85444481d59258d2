"""The clutter benchmark: where bystanders are put, whose contacts count, and what a row of the table says."""

from __future__ import annotations

import itertools

import numpy as np
import voxposer_clutter
from support.voxposer_world import box, snapshot
from voxposer_clutter import Clutter, Contacts, owners, row_of, summary

import vecenv
from vecenv.libero.env import LiberoEnv

THINGS = {
    "can_1": box((0.03, 0.03, 0.04), (-0.1, -0.2, 0.04)),
    "basket_1": box((0.08, 0.08, 0.07), (0.0, 0.25, 0.07)),
    "bottle_1": box((0.02, 0.02, 0.08), (0.2, -0.2, 0.08)),
    "carton_1": box((0.03, 0.03, 0.06), (0.2, 0.1, 0.06)),
    "butter_1": box((0.04, 0.02, 0.01), (-0.07, -0.07, 0.01)),
}


def test_the_tallest_bystanders_stand_in_a_row_across_the_way_and_others_make_room() -> None:
    seen = snapshot(THINGS, goal=(("in", "can_1", "basket_1"),))
    placed = row_of(seen, Clutter("libero_object", 0, 0, "goal", 0.13, 2))
    assert set(placed) == {"bottle_1", "carton_1", "butter_1"}
    start, end = (seen.poses[name][:2] for name in ("can_1", "basket_1"))
    ahead = (end - start) / np.linalg.norm(end - start)
    for name in ("bottle_1", "carton_1"):
        np.testing.assert_allclose((placed[name] - start) @ ahead, 0.13, atol=1e-3)
    everything = {name: placed.get(name, seen.poses[name][:2]) for name in THINGS}
    radius = {name: np.ptp(cloud.points[:, :2], axis=0).max() / 2 for name, cloud in THINGS.items()}
    for one, other in itertools.combinations(everything, 2):
        assert np.linalg.norm(everything[one] - everything[other]) > radius[one] + radius[other]


def test_contacts_with_bystanders_count_and_those_with_the_goal_do_not() -> None:
    env = vecenv.make("libero_object", task=0, episodes=[0])
    assert isinstance(env, LiberoEnv)
    with env:
        env.reset()
        scene = env.physics.groups[0].scene
        assert {"robot", "", *scene.entities} == set(owners(scene).tolist())
        state = env.state()
        address = {name: int(scene.model.joint(scene.entities[name].joints[0]).qposadr[0]) for name in scene.entities}
        carried, other = address["alphabet_soup_1"], address["tomato_sauce_1"]
        state.qpos[0, carried : carried + 2] = state.qpos[0, other : other + 2] + [0.03, 0.0]
        env.set_state(state)
        for own, touched in ((("alphabet_soup_1", "basket_1"), 1), (("alphabet_soup_1", "tomato_sauce_1"), 0)):
            contacts = Contacts(env, [own])
            contacts(np.zeros((1, 7)), np.ones(1, bool))
            assert contacts.ticks.tolist() == [touched]
            assert contacts.touched == ([{"tomato_sauce_1"}] if touched else [set()])


def test_an_episode_is_clean_if_it_is_solved_and_nothing_was_displaced() -> None:
    episode = {"solved": True, "steps": 300, "touching": 4, "touched": ["milk_1"], "displacement": {"milk_1": 0.01}}
    moved = {**episode, "displacement": {"milk_1": voxposer_clutter.DISPLACED + 0.01, "butter_1": 0.0}}
    row = summary("map", [episode, moved, {**episode, "solved": False}])
    assert (row["solved"], row["clean"], row["farthest"]) == (2, 1, 1.7)
