"""Published protocols: what they fix, that make and eval follow them, and that what is given goes before them."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.demos.options import make_options
from vecenv_eval.runner import Evaluation

import vecenv
from vecenv.libero.env import LiberoConfig, LiberoEnv
from vecenv.libero.render.options import RenderConfig
from vecenv.libero.tasks.suites import BASE_SUITES
from vecenv.protocols import DEFAULT, LIBERO, PROTOCOLS, SIMPLER, STATE_PARTS, ProtocolError, ResetLoop, protocol

LIBERO_NAMES = ("seed", "openvla", "openvla-oft", "openpi", "lerobot", "vla-eval", "rlinf", "torchrl")
HORIZONS = {
    "seed": (2500, 2500, 2500, 2500, 2500),
    "openvla": (220, 280, 300, 520, 400),
    "openvla-oft": (220, 280, 300, 520, 400),
    "openpi": (220, 280, 300, 520, 400),
    "lerobot": (280, 280, 300, 520, 400),
    "vla-eval": (220, 280, 300, 520, 400),
    "rlinf": (240, 280, 320, 520, 512),
    "torchrl": (512, 512, 512, 512, 512),
}
SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")
EVERY = [each for known in PROTOCOLS.values() for each in known.values()]
named = pytest.mark.parametrize("each", EVERY, ids=lambda p: f"{p.family}-{p.name}")


def made(name: str, suite: str = "libero_goal", **options: Any) -> LiberoEnv:
    env = vecenv.make(suite, **{"task": 0, "episodes": [0], "protocol": name, **options})
    assert isinstance(env, LiberoEnv)
    env.close()
    return env


# -- the data ----------------------------------------------------------------------------------------------------------


def test_there_are_the_published_ones_and_our_own() -> None:
    assert tuple(PROTOCOLS[LIBERO]) == LIBERO_NAMES
    assert tuple(PROTOCOLS[SIMPLER]) == ("seed", "visual-matching", "variant-aggregation")


@named
def test_every_number_has_a_source(each: Any) -> None:
    assert each.sources
    for source in each.sources:
        assert source.paths
        assert bool(source.repository) == bool(source.commit) == bool(source.date) == (each.name != DEFAULT)


@named
def test_protocols_are_plain_data(each: Any) -> None:
    assert json.loads(json.dumps(each.to_dict()))["name"] == each.name
    with pytest.raises(dataclasses.FrozenInstanceError):
        each.name = "other"
    assert set(each.policy.state) <= set(STATE_PARTS)
    assert set(each.policy.cameras) <= {"agentview", "wrist"}


@pytest.mark.parametrize("name", LIBERO_NAMES)
def test_horizons_are_the_suites_own_and_pro_suites_have_those_of_what_they_vary(name: str) -> None:
    found = protocol(name)
    assert tuple(found.horizon_of(suite) for suite in SUITES) == HORIZONS[name]
    assert found.horizon_of("libero_10_swap") == HORIZONS[name][3]
    assert found.horizon_of("libero_object_object") == HORIZONS[name][1]


def test_a_suite_that_a_protocol_does_not_know_is_refused() -> None:
    with pytest.raises(ProtocolError, match="no horizon for my_suite; it has one for libero_spatial, libero_object"):
        protocol("openpi").horizon_of("my_suite")
    assert protocol("torchrl").horizon_of("my_suite") == 512


def test_rlinfs_seed_goes_up_along_all_tasks_of_the_suite() -> None:
    """500 environments of one process: env i gets seed i and the i-th of (task 0, trial 0), (task 1, trial 0), ..."""
    loop = protocol("rlinf").loop_of("libero_spatial")
    points = [loop.at(0, task, episode) for episode in range(50) for task in range(10)]
    assert [point.seed for point in points] == list(range(500))
    assert {(point.unseeded, point.resets) for point in points} == {(0, 1)}
    assert protocol("rlinf").loop_of("libero_90").at(0, 89, 1).seed == 179


def test_lerobot_seeds_each_episode_after_all_earlier_resets_of_the_environment() -> None:
    point = protocol("lerobot").loop_of("libero_10").at(1000, 3, 4)
    assert (point.seed, point.unseeded, point.resets) == (1004, 5, 1)


@pytest.mark.parametrize(("name", "family"), [("openpi", SIMPLER), ("visual-matching", LIBERO), ("pi", LIBERO)])
def test_protocols_of_another_family_are_refused_with_those_there_are(name: str, family: str) -> None:
    known = ", ".join(PROTOCOLS[family])
    with pytest.raises(ProtocolError, match=rf"'{name}' is not available for {family}; available: {known}"):
        protocol(name, family)
    suite = "simpler/bridge" if family == SIMPLER else "libero_goal"
    for call in (vecenv.make, vecenv.eval_metadata):
        with pytest.raises(ProtocolError, match="is not available"):
            call(suite, protocol=name)
    with pytest.raises(ConfigError, match="is not available"):
        Evaluation(EvalConfig(suite=suite, protocol=name, policy="zero"))


@pytest.mark.parametrize("name", [None, 3, ["openpi"]])
def test_what_is_no_name_is_refused(name: Any) -> None:
    with pytest.raises(ProtocolError, match="is not available for libero"):
        protocol(name)
    with pytest.raises(vecenv.OptionError, match='field "protocol"'):
        vecenv.make("libero_goal", protocol=name)


# -- make --------------------------------------------------------------------------------------------------------------


def test_the_default_protocol_is_what_the_environment_does_by_itself() -> None:
    env = vecenv.make("libero_goal", task=0, episodes=[0])
    assert isinstance(env, LiberoEnv)
    assert vecenv.make_config("libero_goal", {}) == LiberoConfig()
    assert env.config.rules("libero_goal") == LiberoConfig().rules("libero_goal")
    assert env.config.protocol == LiberoConfig().protocol == DEFAULT
    env.close()


@pytest.mark.parametrize("name", LIBERO_NAMES)
def test_make_follows_a_protocol(name: str) -> None:
    chosen, config = protocol(name), made(name).config
    assert config.protocol == name
    for option, value in chosen.options("libero_goal").items():
        assert getattr(config, option) == value
    assert isinstance(config.render, RenderConfig)
    assert (config.render.height, config.render.width) == (chosen.image_size, chosen.image_size)
    assert not chosen.departures("libero_goal", vars(config))


def test_what_is_given_goes_before_the_protocol_even_where_it_is_a_default_elsewhere() -> None:
    given = {"start": "settled", "fixtures": "center", "seed": 0, "max_steps": 2500, "settle_steps": 3}
    render = RenderConfig(height=64, width=64)
    config = made("openpi", **given, success="final", render=render).config
    assert {name: getattr(config, name) for name in given} == given
    assert (config.success, config.render) == ("final", render)
    changed = protocol("openpi").departures("libero_goal", vars(config))
    assert set(changed) == {*given, "success"}
    assert changed["max_steps"] == (300, 2500)


def test_all_episodes_are_the_protocols() -> None:
    assert made("lerobot", episodes=None).num_envs == 10
    assert made("openpi", episodes="all").num_envs == 50
    assert made("lerobot", episodes="12").num_envs == 12


def test_tasks_may_be_named() -> None:
    env = made("seed", task="wine_bottle_on_top_of_the_cabinet")
    (task,) = env.placement.task
    assert vecenv.list_tasks("libero_goal")[task].name == "put_the_wine_bottle_on_top_of_the_cabinet"


# -- eval --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LIBERO_NAMES)
def test_metadata_says_what_a_protocol_fixes(name: str) -> None:
    chosen = protocol(name)
    for suite in BASE_SUITES:
        found = vecenv.eval_metadata(suite, protocol=name)
        assert found["max_steps"] == chosen.horizon_of(suite)
        assert found["num_episodes"] == chosen.episodes * found["num_tasks"]
        assert found["protocol"] == chosen.to_dict()


def test_metadata_is_of_our_own_protocol_by_default() -> None:
    assert vecenv.eval_metadata("libero_10") == vecenv.eval_metadata("libero_10", protocol=DEFAULT)
    assert vecenv.eval_metadata("simpler/bridge")["protocol"]["name"] == DEFAULT


def test_an_evaluation_plans_the_protocols_episodes() -> None:
    planned = Evaluation(EvalConfig(suite="libero_goal", protocol="lerobot", policy="zero", tasks="0,3")).planned
    assert [(e.task, e.episode) for e in planned] == [(task, e) for task in (0, 3) for e in range(10)]
    more = EvalConfig(suite="libero_goal", protocol="lerobot", policy="zero", tasks="0", episodes=[49, 2])
    assert [e.episode for e in Evaluation(more).planned] == [49, 2]


@pytest.mark.parametrize(
    ("suite", "name", "tasks", "count"),
    [
        ("simpler/bridge", "visual-matching", "all", 4 * 24),
        ("simpler/google_robot", "visual-matching", "pick_coke_can", 4 * 3 * 25),
        ("simpler/google_robot", "visual-matching", "move_near_v0", 4 * 60),
        ("simpler/google_robot", "visual-matching", "google_robot_open_drawer, google_robot_close_drawer", 2 * 108),
        ("simpler/google_robot", "visual-matching", "place_apple", 4 * 3 * 9),
        ("simpler/google_robot", "variant-aggregation", "pick_coke_can", 11 * 3 * 25),
        ("simpler/google_robot", "seed", "0,3", 2 * 50),
    ],
)
def test_simplers_tasks_have_as_many_episodes_as_their_protocol(suite: str, name: str, tasks: str, count: int) -> None:
    evaluation = Evaluation(EvalConfig(suite=suite, protocol=name, policy="zero", tasks=tasks))
    assert len(evaluation.planned) == sum(map(len, evaluation.streams())) == count


def test_simplers_metadata_counts_task_by_task_and_leaves_out_what_a_protocol_does_not_have() -> None:
    found = vecenv.eval_metadata("simpler/google_robot", protocol="variant-aggregation")
    per_task = dict(zip(found["instructions"], found["episodes_per_task"], strict=True))
    assert len(found["episodes_per_task"]) == found["num_tasks"] == len(found["max_steps"]) == 21
    assert sum(found["episodes_per_task"]) == found["num_episodes"]
    assert 0 in per_task.values()
    everything = EvalConfig(suite="simpler/google_robot", protocol="variant-aggregation", policy="zero")
    assert len(Evaluation(everything).planned) == found["num_episodes"]
    without = found["episodes_per_task"].index(0)
    with pytest.raises(ConfigError, match=f"has no episodes of task {without} of simpler/google_robot"):
        Evaluation(dataclasses.replace(everything, tasks=str(without)))
    with pytest.raises(ConfigError, match="no episodes of simpler/bridge"):
        Evaluation(dataclasses.replace(everything, suite="simpler/bridge"))


def test_recordings_hold_the_options_that_a_protocol_stands_for() -> None:
    options = make_options(vecenv.make, suite="libero_spatial", protocol="openpi", max_steps=7)
    assert options["reset_loop"] == dataclasses.asdict(ResetLoop())
    expected = {"max_steps": 7, "seed": 7, "start": "raw", "settle_steps": 10, "fixtures": "upstream"}
    assert {name: options[name] for name in expected} == expected
    assert "protocol" not in options
    assert "reset_loop" not in make_options(vecenv.make)
