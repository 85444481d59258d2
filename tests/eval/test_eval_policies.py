"""How a name becomes a policy, and what the simple ones do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.fakes import FakeEnv
from vecenv_eval.policies import Policy, PolicyError, make_policy
from vecenv_eval.policies.random import RandomPolicy
from vecenv_eval.policies.scripted import ZeroPolicy


def acts(policy: Policy, env: FakeEnv, ticks: int) -> np.ndarray:
    """Actions of a policy over some ticks, [ticks, B, 7]."""
    policy.reset(env, env.reset())
    return np.stack([np.asarray(policy.act(env)) for _ in range(ticks)])


@pytest.mark.parametrize("name", ["random", "zero"])
def test_built_in_policies_are_known_by_name(name: str) -> None:
    policy = make_policy(name)
    assert policy.name == name
    actions = acts(policy, FakeEnv([0, 1], [0, 1, 2]), 2)
    assert actions.shape == (2, 6, 7)
    assert np.abs(actions).max() <= 1


def test_zero_holds_still_with_the_gripper_as_told() -> None:
    np.testing.assert_array_equal(acts(ZeroPolicy(), FakeEnv([0], [0]), 1)[0, 0], [0, 0, 0, 0, 0, 0, -1])
    np.testing.assert_array_equal(acts(ZeroPolicy(gripper=1), FakeEnv([0], [0]), 1)[0, 0], [0, 0, 0, 0, 0, 0, 1])


def test_random_actions_depend_on_seed_and_episode_but_not_on_the_batch() -> None:
    ticks = 300  # more than one block of draws
    together = acts(RandomPolicy(seed=3), FakeEnv([0, 1], [0, 1]), ticks)
    alone = acts(RandomPolicy(seed=3), FakeEnv([1], [0]), ticks)
    np.testing.assert_array_equal(together[:, 2], alone[:, 0])
    assert not np.array_equal(together[:, 2], acts(RandomPolicy(seed=4), FakeEnv([1], [0]), ticks)[:, 0])
    assert len(np.unique(together.reshape(-1, 7), axis=0)) == ticks * 4


def test_random_actions_begin_again_at_reset() -> None:
    policy, env = RandomPolicy(), FakeEnv([0], [0, 1])
    np.testing.assert_array_equal(acts(policy, env, 5), acts(policy, env, 5))


def test_random_actions_can_be_held() -> None:
    held = acts(RandomPolicy(seed=1, hold=4), FakeEnv([0], [0]), 12)[:, 0]
    free = acts(RandomPolicy(seed=1), FakeEnv([0], [0]), 3)[:, 0]
    np.testing.assert_array_equal(held, np.repeat(free, 4, axis=0))
    with pytest.raises(ValueError, match="hold must be at least 1"):
        RandomPolicy(hold=0)


def test_the_seed_goes_to_policies_that_take_one() -> None:
    env = FakeEnv([0], [0])
    np.testing.assert_array_equal(acts(make_policy("random", seed=5), env, 3), acts(RandomPolicy(seed=5), env, 3))
    own = {"seed": 6}
    np.testing.assert_array_equal(acts(make_policy("random", **own), env, 3), acts(RandomPolicy(seed=6), env, 3))


MODULE = """
class Mine:
    name = "mine"
    def __init__(self, speed, twice=False):
        self.speed = speed
    def reset(self, env, info): ...
    def act(self, env): ...

class NoPolicy: ...

number = 3
"""


@pytest.fixture
def my_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "a_users_policies.py").write_text(MODULE)
    (tmp_path / "a_broken_module.py").write_text("import no_such_thing_anywhere")
    monkeypatch.syspath_prepend(tmp_path)
    return "a_users_policies"


def test_a_users_own_policy_goes_by_module_and_class(my_module: str) -> None:
    assert vars(make_policy(f"{my_module}:Mine", speed=2)) == {"speed": 2}


@pytest.mark.parametrize(
    ("name", "arguments", "says"),
    [
        ("rando", {}, "unknown policy 'rando': did you mean random"),
        (
            "qqq",
            {},
            "unknown policy 'qqq': did you mean gr00t, openpi, pick_place, random, simpler_scripted, starvla, "
            "vla-eval, voxposer, zero",
        ),
        ("module:", {}, "unknown policy 'module:'"),
        ("no_such_module:Class", {}, "importing 'no_such_module' failed: ModuleNotFoundError"),
        ("a_broken_module:Class", {}, "ModuleNotFoundError: No module named 'no_such_thing_anywhere'"),
        ("a_users_policies:Nobody", {}, "has no class 'Nobody'"),
        ("a_users_policies:number", {}, "has no class 'number'"),
        ("a_users_policies:NoPolicy", {}, r"is not a policy: it needs a name, reset\(env, info\) and act\(env\)"),
        ("a_users_policies:Mine", {}, "missing a required argument: 'speed'; arguments it takes: speed, twice"),
        (
            "a_users_policies:Mine",
            {"speed": 1, "x": 2},
            "unexpected keyword argument 'x'; arguments it takes: speed, twice",
        ),
        ("zero", {"gripped": 1}, "unexpected keyword argument 'gripped'; arguments it takes: gripper"),
    ],
)
@pytest.mark.usefixtures("my_module")
def test_policies_that_cannot_be_made_say_why(name: str, arguments: dict[str, object], says: str) -> None:
    with pytest.raises(PolicyError, match=says):
        make_policy(name, **arguments)  # pyright: ignore[reportArgumentType]
