"""The examples do what they say: PPO learns and resumes, derivatives agree, missing extras and options are named."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.paths import REPOSITORY

import vecenv
from vecenv import interop
from vecenv.libero.env import LiberoEnv
from vecenv.libero.physics.budgets import Budget

pytest.importorskip("optax")

EXAMPLES = REPOSITORY / "examples"
# LLVM's optimisation off: programs compile several times faster.
compiled = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def imported(name: str) -> ModuleType:
    """An example as a module; it finds those beside it, as a script does."""
    spec = importlib.util.spec_from_file_location(f"examples_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    sys.path.insert(0, str(EXAMPLES))
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[spec.name]
        raise
    finally:
        sys.path.remove(str(EXAMPLES))
    return module


ppo = imported("ppo")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Point:
    """A point in a square and a place to go to."""

    pos: jax.Array
    goal: jax.Array
    obs: Any
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]


class PointMass:
    """Go to a place. The reward is what the distance shrinks by, and 1 for being there."""

    action_size, observation_size = 2, 4

    def reset(self, rng: jax.Array) -> Point:
        pos, goal = jax.random.uniform(rng, (2, 2), minval=-1, maxval=1)
        return self._state(pos, goal, jnp.zeros(()))

    def step(self, state: Point, action: jax.Array) -> Point:
        pos = state.pos + 0.1 * jnp.clip(action, -1, 1)
        gained = jnp.linalg.norm(state.pos - state.goal) - jnp.linalg.norm(pos - state.goal)
        return self._state(pos, state.goal, gained)

    def _state(self, pos: jax.Array, goal: jax.Array, reward: jax.Array) -> Point:
        there = (jnp.linalg.norm(pos - goal) < 0.1).astype(jnp.float32)
        return Point(pos, goal, jnp.concatenate([pos, goal]), reward + there, there, {"success": there})


class Latched(PointMass):
    """Moves only while a switch, the last action, is on the side on which the goal lies."""

    action_size = 3

    def step(self, state: Point, action: jax.Array) -> Point:
        free = action[2] * (state.goal[0] - state.pos[0]) > 0
        return super().step(state, jnp.where(free, action[:2], 0.0))


class Clock:
    """Episode and reward are ticks: succeeds after the number of ticks drawn at the reset, from 2 to 5."""

    action_size, observation_size = 1, 2

    def reset(self, rng: jax.Array) -> Point:
        ticks = jax.random.randint(rng, (1,), 2, 6).astype(jnp.float32)
        return self._state(jnp.zeros(1), ticks)

    def step(self, state: Point, action: jax.Array) -> Point:
        return self._state(state.pos + 1, state.goal)

    def _state(self, pos: jax.Array, goal: jax.Array) -> Point:
        there = (pos >= goal)[0].astype(jnp.float32)
        return Point(pos, goal, jnp.concatenate([pos, goal]), pos[0], there, {"success": there})


class Flags(PointMass):
    """As before, seen in images."""

    observation_size: Any

    def __init__(self, *shapes: tuple[int, ...]) -> None:
        self.observation_size = {"state": (3,), **{f"pixels/view_{n}": shape for n, shape in enumerate(shapes)}}


SMALL = ppo.PPOConfig(
    steps=20_000, num_envs=64, episode_length=30, minibatches=8, hidden=(32, 32), learning_rate=3e-3, initial_std=0.6
)


def run(out: Path, config: Any = SMALL, **options: Any) -> Any:
    return ppo.train(PointMass(), config, out, **{"jit": compiled, "report": lambda line: None, **options})


# -- PPO ---------------------------------------------------------------------------------------------------------------


def test_ppo_learns_to_go_to_a_place(tmp_path: Path) -> None:
    trained = run(tmp_path)
    assert trained.rows[1]["success"] < 0.5
    assert trained.rows[-1]["success"] > 0.9
    assert trained.success > 0.95
    assert trained.rows[-1]["env_steps"] >= SMALL.steps
    assert ppo.plot(tmp_path / "curve.png", trained.rows, "point mass") == (tmp_path / "curve.png").is_file()


def test_ppo_learns_when_to_turn_a_switch(tmp_path: Path) -> None:
    config = dataclasses.replace(SMALL, steps=40_000, switches=1)
    trained = ppo.train(Latched(), config, tmp_path, jit=compiled, report=lambda line: None)
    assert trained.rows[1]["success"] < 0.5
    assert trained.success > 0.9


def test_images_are_seen_by_policy_and_value_function() -> None:
    rng, env = np.random.default_rng(0), Flags((36, 36, 1), (36, 36, 1))
    networks = ppo.init_networks(jax.random.key(0), env, SMALL)
    views = {f"pixels/view_{n}": jnp.asarray(rng.uniform(size=(2, 36, 36, 1)), jnp.float32) for n in range(2)}
    obs = ppo.packed({"state": jnp.zeros((2, 3)), **views})
    assert obs.images is not None
    assert (obs.images.shape, obs.images.dtype) == ((2, 36, 36, 2), jnp.uint8)
    np.testing.assert_allclose(obs.images[..., 1] / 255, views["pixels/view_1"][..., 0], atol=0.5 / 255 + 1e-6)

    def outcome(networks: Any) -> jax.Array:
        return ppo.mean_of(networks, obs).sum() + ppo.value_of(networks, obs).sum()

    gradient = jax.grad(outcome)(networks)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradient.vision))
    blank = obs._replace(images=jnp.zeros_like(obs.images))
    assert np.abs(ppo.value_of(networks, obs) - ppo.value_of(networks, blank)).max() > 0
    assert ppo.Normalizer(jnp.ones(()), jnp.zeros(3), jnp.ones(3))(obs).images is obs.images


def test_switches_are_drawn_as_their_probability_says() -> None:
    logits = jnp.broadcast_to(jnp.asarray([0.0, 2.0, -9.0]), (20_000, 3))
    actions = ppo.Actions(jnp.zeros((20_000, 2)), jnp.asarray([0.5, 1.0]), logits)
    drawn = np.asarray(actions.draw(jax.random.key(0), jnp.ones(())))
    assert set(np.unique(drawn[:, 2:])) == {-1.0, 1.0}
    np.testing.assert_allclose((drawn[:, 2:] > 0).mean(0), 1 / (1 + np.exp([0, -2, 9])), atol=0.02)
    np.testing.assert_allclose(drawn[:, :2].std(0), [0.5, 1.0], rtol=0.05)
    np.testing.assert_array_equal(np.sign(actions.draw(jax.random.key(0), jnp.zeros(())))[0], [0, 0, -1, 1, -1])
    both = jnp.asarray([[0.0, 0.0, s, t, -1.0] for s in (-1, 1) for t in (-1, 1)])
    chances = np.exp(actions._replace(mean=jnp.zeros((4, 2)), logits=logits[:4]).log_probability(both))
    density = 1 / (2 * np.pi * 0.5)  # of the two normal numbers, at their mean
    assert chances.sum() / density == pytest.approx(1 / (1 + np.exp(-9)), rel=1e-4)


def test_a_policy_keeps_trying_both_sides_of_a_switch_and_noise_has_a_least_deviation() -> None:
    networks = ppo.init_networks(jax.random.key(0), PointMass(), SMALL)
    *lower, last = networks.policy
    sure = [*lower, {**last, "bias": jnp.full_like(last["bias"], 100.0)}]
    networks = networks._replace(policy=sure, log_std=jnp.full_like(networks.log_std, -9))
    obs = ppo.Obs(jnp.zeros((1, PointMass.observation_size)), None)
    actions = ppo.actions_of(networks, obs, dataclasses.replace(SMALL, switches=1, min_std=0.1))
    assert actions.logits.shape == (1, 1)
    assert 0.98 < jax.nn.sigmoid(actions.logits).item() < 0.99
    np.testing.assert_allclose(actions.std, 0.1, rtol=1e-6)
    assert np.sign(ppo.mean_of(networks, obs)).item(-1) == 1


@pytest.mark.parametrize(
    ("shapes", "message"), [(((36, 36, 1), (40, 40, 1)), "expected one shape"), (((16, 16, 3),), "too small")]
)
def test_images_that_do_not_fit_are_refused(shapes: tuple[tuple[int, ...], ...], message: str) -> None:
    with pytest.raises(ppo.RunError, match=message):
        ppo.init_networks(jax.random.key(0), Flags(*shapes), SMALL)


def test_what_was_learnt_acts_in_an_evaluation(tmp_path: Path) -> None:
    policies = imported("ppo_policy")
    own = sys.modules["ppo"]
    options = vars(own.parser().parse_args(["--objective", "goal", "--hidden", "8", "--out", str(tmp_path)]))
    (tmp_path / own.SETTINGS).write_text(json.dumps({**options, "out": "", "hidden": [8], "action_repeat": 2}))
    env = vecenv.make("libero_object", tasks=[0], episodes=[3, 4])
    assert isinstance(env, LiberoEnv)
    with env:
        info = env.reset()
        with pytest.raises(own.RunError, match=r"policy.npz does not exist"):
            policies.PpoPolicy(str(tmp_path)).reset(env, info)
        budget = Budget(contacts=1, rows=1, pairs=1, candidates=1)
        inner = own.make_env(own.parser().parse_args(["--out", "x"]), impl="jax", budget=budget)
        shape = dataclasses.replace(SMALL, hidden=(8,))
        networks = own.init_networks(jax.random.key(0), own.Upright(inner), shape)
        networks = networks._replace(policy=jax.tree.map(lambda x: x + 0.05, networks.policy))
        normalizer = own.Normalizer(jnp.ones(()), jnp.zeros(inner.observation_size), jnp.ones(inner.observation_size))
        own.save(tmp_path / own.POLICY, own.Learnt(networks, normalizer))
        policy = policies.PpoPolicy(str(tmp_path))
        policy.reset(env, info)
        actions = policy.act(env)
        obs = own.Obs(jnp.asarray(inner.observe_batch(env.physics)), None)
        mean = np.asarray(own.mean_of(networks, normalizer(obs)))
        assert actions.shape == (2, 2, 7)
        np.testing.assert_allclose(actions[:, 0][:, [0, 1, 2, 6]], mean, atol=1e-6)
        np.testing.assert_array_equal(actions[:, 0], actions[:, 1])
        assert not actions[..., 3:6].any()
        assert np.abs(actions[0] - actions[1]).max() > 0  # they see different starts
    other = vecenv.make("libero_object", tasks=[1], episodes=[0])
    with other, pytest.raises(own.RunError, match=r"trained on libero_object 0, not on libero_object 1"):
        policy.reset(other, other.reset())


def test_a_run_that_was_interrupted_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    config = dataclasses.replace(SMALL, steps=4 * SMALL.steps_per_iteration)
    whole = run(tmp_path / "whole", config)

    def interrupt(line: str) -> None:
        if line.startswith(f"{3 * SMALL.steps_per_iteration:>11,}"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "parts", config, checkpoint_seconds=0, report=interrupt)
    parts = run(tmp_path / "parts", config, resume=True)
    for a, b in zip(jax.tree.leaves(whole.learner), jax.tree.leaves(parts.learner), strict=True):
        np.testing.assert_array_equal(a, b)
    rows = ppo.read_rows(tmp_path / "parts" / "curve.csv", until=10**9)
    for row in (*whole.rows, *rows):
        assert row.pop("seconds") > 0
    assert rows == [pytest.approx(row) for row in whole.rows]


def test_a_checkpoint_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    tree = {"weight": jnp.arange(3.0), "count": jnp.zeros((), jnp.int32)}
    path = tmp_path / "checkpoint.npz"
    with pytest.raises(ppo.RunError, match="start without --resume"):
        ppo.load(path, tree)
    ppo.save(path, tree, seconds=1.5)
    found, numbers = ppo.load(path, jax.tree.map(jnp.zeros_like, tree), "seconds")
    assert numbers == {"seconds": 1.5}
    jax.tree.map(np.testing.assert_array_equal, found, tree)
    for wrong in ({**tree, "weight": jnp.zeros(4)}, {**tree, "bias": jnp.zeros(3)}, {**tree, "count": jnp.zeros(())}):
        with pytest.raises(ppo.RunError, match="resume with the task and settings"):
            ppo.load(path, wrong)


def test_a_training_is_compiled_once() -> None:
    first = jax.eval_shape(functools.partial(ppo.init_learner, PointMass(), SMALL))
    then, _, _ = jax.eval_shape(functools.partial(ppo.iteration, PointMass(), SMALL), first, jnp.ones(()))
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(then), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)


def test_advantages_are_those_of_a_plain_loop() -> None:
    rng = np.random.default_rng(0)
    ticks, worlds = 7, 5
    networks = ppo.init_networks(jax.random.key(1), PointMass(), SMALL)
    networks = networks._replace(value=jax.tree.map(lambda x: x + 0.1, networks.value))
    normalizer = ppo.Normalizer(jnp.ones(()), jnp.zeros(4), jnp.ones(4))
    obs, following = rng.normal(size=(2, ticks, worlds, 4)).astype(np.float32)
    reward = rng.normal(size=(ticks, worlds)).astype(np.float32)
    terminated = rng.random((ticks, worlds)) < 0.2
    ended = terminated | (rng.random((ticks, worlds)) < 0.2)
    zeros = np.zeros((ticks, worlds, 2), np.float32)
    obs, following = ppo.Obs(obs, None), ppo.Obs(following, None)
    data = ppo.Transition(obs, zeros, reward, reward, following, terminated, ended)
    found, targets = ppo.advantages(networks, normalizer, data, SMALL)
    value = np.asarray(ppo.value_of(networks, obs))
    value_after = np.asarray(ppo.value_of(networks, following))
    for world in range(worlds):
        later = 0.0
        for t in reversed(range(ticks)):
            onwards = 0.0 if terminated[t, world] else value_after[t, world]
            delta = reward[t, world] + SMALL.discount * onwards - value[t, world]
            later = delta + (0.0 if ended[t, world] else SMALL.discount * SMALL.gae * later)
            assert found[t, world] == pytest.approx(later, rel=1e-4, abs=1e-5)
    np.testing.assert_allclose(targets, found + value, rtol=1e-5, atol=1e-6)


def test_log_probabilities_are_those_of_a_normal_distribution() -> None:
    mean, action = jax.random.normal(jax.random.key(0), (2, 6, 3))
    std = jnp.array([0.1, 1.0, 2.5])
    expected = jax.scipy.stats.norm.logpdf(action, mean, std).sum(-1)
    actions = ppo.Actions(mean, std, jnp.zeros((*mean.shape[:-1], 0)))
    np.testing.assert_allclose(actions.log_probability(action), expected, rtol=1e-5)


def test_the_normalizer_keeps_mean_and_variance_of_all_it_saw() -> None:
    parts = [np.random.default_rng(n).normal(3, 2, (n, 2, 4)) for n in (5, 1, 40)]
    normalizer = ppo.Normalizer(jnp.zeros(()), jnp.zeros(4), jnp.zeros(4))
    for part in parts:
        normalizer = normalizer.updated(jnp.asarray(part))
    everything = np.concatenate(parts).reshape(-1, 4)
    np.testing.assert_allclose(normalizer.mean, everything.mean(0), rtol=1e-4)
    np.testing.assert_allclose(normalizer.var, everything.var(0), rtol=1e-4)
    assert normalizer(ppo.Obs(jnp.full(4, 1e9), None)).vector.tolist() == [10.0] * 4


def test_repeated_actions_stop_where_an_episode_ends() -> None:
    env = Clock()
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 32))
    after, reward = ppo.advance(env, state, jnp.zeros((32, 1)), 4)
    ticks = np.asarray(state.goal)[:, 0]
    np.testing.assert_array_equal(after.pos[:, 0], np.minimum(ticks, 4))
    np.testing.assert_array_equal(after.done, ticks <= 4)
    np.testing.assert_array_equal(reward, [sum(range(1, int(min(n, 4)) + 1)) for n in ticks])


@pytest.mark.parametrize("noise", [1.0, 0.0])
def test_statistics_without_noise_count_one_episode_a_world(noise: float) -> None:
    env, config = Clock(), dataclasses.replace(SMALL, num_envs=32, unroll=12, episode_length=4)
    worlds = ppo.begin(env, jax.random.key(3), config, staggered=False)
    ticks = np.asarray(worlds.state.goal)[:, 0]
    networks = ppo.init_networks(jax.random.key(1), env, config)
    normalizer = ppo.Normalizer(jnp.ones(()), jnp.zeros(2), jnp.ones(2))
    _, data, sums = ppo.rollout(env, networks, normalizer, worlds, jax.random.key(2), config, jnp.asarray(noise))
    if noise:
        assert sums.episodes == data.ended.sum() > 64
        return
    assert sums.episodes == 32
    assert sums.success == (ticks <= 4).sum()
    assert sums.length == np.minimum(ticks, 4).sum()
    # Cut off is not over: what follows still has a value.
    first = np.asarray(data.ended).argmax(0)
    np.testing.assert_array_equal(np.asarray(data.terminated)[first, np.arange(32)], ticks <= 4)


# -- command lines -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--suite", "libero_objects"], "libero_objects"),
        (["--task", "10"], "0 to 9"),
        (["--minibatches", "7"], "minibatches=7"),
        (["--resume"], "no run to resume"),
        (["--steps", "1.5"], "no whole number"),
        (["--objective", "fly"], "fly"),
        (["--scenes", "nowhere"], "nowhere"),
    ],
)
def test_a_wrong_option_of_ppo_is_named(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        ppo.main(["--out", str(tmp_path / "run"), *arguments])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_an_error_that_is_not_meant_for_users_keeps_its_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def defect(*_: object) -> None:
        raise ValueError("operands could not be broadcast together")

    monkeypatch.setattr(ppo, "make_env", defect)
    with pytest.raises(ValueError, match="broadcast"):
        ppo.main(["--out", str(tmp_path)])


@pytest.mark.parametrize(
    ("name", "missing", "message"),
    [
        ("ppo", "optax", "optax"),
        ("brax_ppo", "brax.training.agents.ppo", "Brax"),
        ("brax_ppo", "mujoco_playground", "Playground"),
    ],
)
def test_a_missing_extra_is_named(name: str, missing: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.delitem(sys.modules, "vecenv.interop.playground", raising=False)
    # An import of a module looks at its package's attributes first.
    monkeypatch.delattr(interop, "playground", raising=False)
    with pytest.raises(SystemExit, match=rf"{message}.*vecenv\[train\]"):
        imported(name)


def test_a_hand_that_stays_upright_is_told_no_rotations() -> None:
    told: list[np.ndarray] = []

    class Env:
        observation_size, reset = 3, None

        def step(self, state: None, action: jax.Array) -> None:
            told.append(np.asarray(action))

    ppo.Upright(Env()).step(None, jnp.array([0.1, 0.2, 0.3, -1.0]))
    np.testing.assert_allclose(told[0], [0.1, 0.2, 0.3, 0, 0, 0, -1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--num-envs", "30"], "does not divide"), (["--restore", "nowhere"], "nowhere"), (["--task", "10"], "0 to 9")],
)
def test_a_wrong_option_of_brax_ppo_is_named(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("brax")
    with pytest.raises(SystemExit) as ended:
        imported("brax_ppo").main(["--out", str(tmp_path), *arguments])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


# -- on LIBERO ---------------------------------------------------------------------------------------------------------

TINY = ["--impl", "warp", "--num-envs", "4", "--unroll", "3", "--minibatches", "2", "--episode-length", "4"]


@pytest.mark.heavy
def test_ppo_trains_on_a_task_and_resumes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path)]
    ppo.main([*TINY, *out, "--objective", "lift", "--hidden", "8", "--action-repeat", "2", "--steps", "48"])
    ppo.main([*out, "--resume", "--steps", "72"])
    rows = ppo.read_rows(tmp_path / "curve.csv", until=10**9)
    assert [row["env_steps"] for row in rows] == [24, 48, 72]
    assert all(np.isfinite(list(row.values())).all() for row in rows)
    assert sum(row["episodes"] for row in rows) > 0
    assert not any(row["faults"] for row in rows)
    result = json.loads((tmp_path / "result.json").read_text())
    assert (result["env_steps"], result["impl"], result["target"]) == (72, "warp", "alphabet_soup_1")
    assert json.loads((tmp_path / "config.json").read_text())["hidden"] == [8]


@pytest.mark.heavy
@pytest.mark.parametrize("options", [[], ["--randomize"]])
def test_brax_trains_on_a_task(options: list[str], tmp_path: Path) -> None:
    pytest.importorskip("brax")
    few = ["--steps", "24", "--num-eval-envs", "4", "--num-evals", "2", "--hidden", "8", "--epochs", "1"]
    imported("brax_ppo").main([*TINY, *few, "--out", str(tmp_path), *options])
    rows = (tmp_path / "curve.csv").read_text().splitlines()
    assert rows[0].startswith("env_steps,seconds,return,success")
    assert [row.split(",")[0] for row in rows[1:]] == ["0", "24"]
    assert list((tmp_path / "checkpoints").iterdir())


@pytest.mark.heavy
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_derivatives_of_a_rollout_agree_with_finite_differences(mode: str) -> None:
    command = [sys.executable, EXAMPLES / "grad.py", "--ticks", "1", "--mode", mode]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.split() for line in done.stdout.splitlines()]
    found = {row[1]: (float(row[2]), float(row[3])) for row in rows if len(row) == 5 and row[0] == "0"}
    assert list(found) == ["x", "y", "z", "rx", "ry", "rz", "gripper"]
    slopes, differences = np.array(list(found.values())).T
    assert (np.abs(slopes[:6]) > 1e-4).all()
    np.testing.assert_allclose(slopes[:3], differences[:3], rtol=1e-5)
    np.testing.assert_allclose(slopes[3:6], differences[3:6], rtol=0.02)
    assert slopes[6] == differences[6] == 0


def test_a_wrong_option_of_grad_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in ((["--ticks", "0"], "at least 1"), (["--task", "10"], "0 to 9")):
        with pytest.raises(SystemExit) as ended:
            imported("grad").main(arguments)
        assert ended.value.code == 2
        assert message in capsys.readouterr().err
