"""Several suites and seeds as one evaluation: every pair a run of its own, and averages as papers print them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.fakes import FakeEnv, FakeWorld
from vecenv_eval.campaign import CAMPAIGN, Campaign, is_campaign, legs, markdown
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.episodes import Suite
from vecenv_eval.report.run import read_run
from vecenv_eval.simulator import Simulator
from vecenv_eval.store import ResultStore, StoreError


class Worlds:
    """Two suites: in the second one, the odd tasks alone are planned, which nobody solves."""

    def __init__(self) -> None:
        self.world = FakeWorld()
        self.made: list[tuple[str, int | None]] = []

    def suite(self, name: str, protocol: str) -> Suite:
        if name not in ("libero_goal", "libero_10"):
            raise ConfigError(f"unknown suite {name!r}")
        return replace(self.world.suite, name=name)

    def make(self, suite: str, *, seed: int | None = None, **arguments: Any) -> FakeEnv:
        self.made.append((suite, seed))
        env = self.world.make("fake_suite", **arguments)
        reset = env.reset

        def renamed() -> Any:
            info = reset()
            ids = tuple(text.replace("fake_suite", suite) for text in info.episode_id)
            return replace(info, suite=suite, episode_id=ids)

        env.reset = renamed  # type: ignore[method-assign]
        return env

    @property
    def simulator(self) -> Simulator:
        return Simulator(self.suite, self.make)


def config(**settings: Any) -> EvalConfig:
    return EvalConfig(**{"suite": "libero_goal,libero_10", "policy": "zero", **settings})


def test_one_suite_and_one_seed_are_no_campaign() -> None:
    assert not is_campaign(config(suite="libero_goal"))
    assert is_campaign(config())
    assert is_campaign(config(suite="libero_goal", seeds="3"))


def test_every_pair_has_a_results_folder_of_its_own(tmp_path: Path) -> None:
    worlds = Worlds()
    campaign = Campaign(config(seeds="0,7"), tmp_path / "c", worlds.simulator)
    summary, results = campaign.run()
    assert worlds.made == [("libero_goal", 0), ("libero_goal", 7), ("libero_10", 0), ("libero_10", 7)]
    assert all(result.ok for result in results)
    for leg in campaign.legs:
        assert leg.folder == tmp_path / "c" / f"seed-{leg.seed}" / leg.suite
        assert len(ResultStore.open(leg.folder).records()) == 20
    assert [row.rates for row in summary.suites] == [(0.5, 0.5)] * 2
    assert (summary.average, summary.average_std) == (0.5, 0.0)
    assert json.loads((tmp_path / "c" / "summary.json").read_text())["average"] == 0.5


def test_the_average_counts_each_suite_once(tmp_path: Path) -> None:
    campaign = Campaign(config(tasks="0-1"), tmp_path / "c", Worlds().simulator)
    campaign.legs[1] = replace(campaign.legs[1], config=replace(campaign.legs[1].config, tasks="1", episodes="1"))
    summary, _ = campaign.run()
    assert [row.mean for row in summary.suites] == [0.5, 0.0]
    assert summary.average == 0.25  # 5 of 11 episodes were solved
    text = markdown(summary)
    assert "| libero_goal | 50.0% | 10 | 0 |" in text
    assert "| average over suites | 25.0% |" in text


def test_a_campaign_is_continued_where_it_stopped(tmp_path: Path) -> None:
    first = Campaign(config(), tmp_path / "c", Worlds().simulator)
    full = first.legs
    first.legs = full[:1]
    first.run()
    worlds = Worlds()
    summary, results = Campaign.open(tmp_path / "c", worlds.simulator).run()
    assert worlds.made == [("libero_10", None)]
    assert len(results) == 2
    assert [row.episodes for row in summary.suites] == [20, 20]


def test_settings_are_checked_for_every_suite_before_any_runs(tmp_path: Path) -> None:
    worlds = Worlds()
    with pytest.raises(ConfigError, match="unknown suite 'libero_0'"):
        Campaign(config(suite="libero_goal,libero_0"), tmp_path / "c", worlds.simulator)
    assert worlds.made == []
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"seeds": "0,one"}, "write whole numbers"),
        ({"seeds": "0", "seed": 1}, "seed or seeds"),
        ({"suite": ","}, "no suite"),
    ],
)
def test_seeds_and_suites_that_are_none_are_refused(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        legs(config(**settings), Path("c"))


def test_a_folder_in_the_way_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("here")
    with pytest.raises(StoreError, match="already there and not empty"):
        Campaign(config(), tmp_path, Worlds().simulator).run()
    with pytest.raises(StoreError, match=CAMPAIGN):
        Campaign.open(tmp_path / "elsewhere")


def test_a_report_of_several_seeds_asks_which(tmp_path: Path) -> None:
    Campaign(config(seeds="0,7"), tmp_path / "c", Worlds().simulator).run()
    with pytest.raises(StoreError, match=r"several seeds: name one, or two to compare them: .*seed-0, .*seed-7"):
        read_run(tmp_path / "c")
    assert [suite.suite for suite in read_run(tmp_path / "c" / "seed-7").suites] == ["libero_goal", "libero_10"]
