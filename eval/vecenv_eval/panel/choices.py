"""What the panel's fields and a client's requests mean for the config of a live session."""

from __future__ import annotations

from typing import Any

import vecenv
from vecenv.errors import VecenvError
from vecenv_eval.config import SCRIPTED, EvalConfig, default_policy
from vecenv_eval.panel import catalog
from vecenv_eval.panel.state import Fields, OutOfTurn, SessionError
from vecenv_eval.runner import check, chosen_episodes
from vecenv_eval.simulator import Simulator, vecenv_simulator

# Names of fields in graphs -> ours.
_FIELDS = {"split": "suite", "task_id": "task", "episode_index": "episode"}
# What is made for one family of suites and means nothing, or something else, for another.
_OF_A_FAMILY = ("image_size", "lod", "colors", "max_steps", "seed", "cameras")


def check_live(config: EvalConfig, simulator: Simulator | None = None) -> None:
    """Check a config of a session without building anything.

    Raises:
        ConfigError, SpecError, PolicyError: something in the config does not exist or does not fit.
        SessionError: it is not one suite with one seed in this process.
    """
    if len(config.suites) != 1 or config.seeds is not None:
        raise SessionError("a session runs one suite with one seed")
    if config.engine != "local":
        raise SessionError("a session runs in this process: leave out the engine")
    check(config, simulator or vecenv_simulator())


def config_for(before: EvalConfig | None, suite: str, **changes: Any) -> EvalConfig:
    """A config for a suite: another one with changes; what is made for another family of suites is dropped.

    Args:
        before: the config to start from, None for the defaults.
        suite: the suite.
        **changes: fields of ``EvalConfig``.

    Raises:
        SessionError: there is no such suite.
        ConfigError: a value cannot be used.
    """
    catalog.check_suite(suite)
    if before is None:
        return EvalConfig.from_dict({"suite": suite, **changes})
    values = {**before.to_dict(), "suite": suite, "num_envs": None}
    if vecenv.family(suite) != vecenv.family(before.suites[0]):
        values |= dict.fromkeys(_OF_A_FAMILY) | {"env_args": {}}
        if before.policy_name in SCRIPTED.values():
            values |= {"policy": default_policy(suite), "policy_args": {}}
    return EvalConfig.from_dict({**values, **changes})


def config_of(before: EvalConfig | None, fields: Fields) -> EvalConfig:
    """A config for the one episode that the fields select."""
    assert fields.suite is not None
    assert fields.task is not None
    task = catalog.task_index(fields.suite, fields.task)
    return config_for(before, fields.suite, tasks=str(task), episodes=f"{fields.episode}-{fields.episode}")


def chosen(now: Fields, name: str, value: int | str) -> Fields:
    """The fields with one of them chosen, and those below it in the cascade at their first value.

    Raises:
        OutOfTurn: no suite was chosen yet.
        SessionError: there is no such field, suite, task or episode.
    """
    field = _FIELDS.get(name, name)
    if field == "suite":
        return Fields(suite=str(value), task=catalog.tasks(str(value))[0].task, episode=0)
    if field not in ("task", "episode"):
        raise SessionError(f"there is no field {field!r}: suite, task or episode")
    if now.suite is None:
        raise OutOfTurn("choose a suite first")
    rows = catalog.tasks(now.suite)
    task = value if field == "task" else now.task if now.task is not None else rows[0].task
    row = rows[catalog.task_index(now.suite, task)]
    if field == "task":
        return Fields(suite=now.suite, task=row.task, episode=0)
    text = str(value)
    if not (text.isascii() and text.isdecimal() and len(text) < 10 and int(text) < row.num_episodes):
        raise SessionError(f"task {row.task} of {now.suite} has episodes 0 to {row.num_episodes - 1}, no {text!r}")
    return Fields(suite=now.suite, task=row.task, episode=int(text))


def first_of(config: EvalConfig, simulator: Simulator) -> Fields:
    """The first task and episode of a config, as the panel shows them; nothing of one that cannot be built."""
    try:
        suite = simulator.suite_of(config)
        tasks, episodes = chosen_episodes(config, suite)
    except VecenvError:  # the build says what is wrong with it
        return Fields()
    named = suite.tasks and config.suite.startswith("simpler/")
    task = suite.tasks[tasks[0]] if named else tasks[0]
    return Fields(suite=suite.name, task=task, episode=episodes[tasks[0]][0])
