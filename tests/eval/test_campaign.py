"""Several suites and seeds as one evaluation: every pair a run of its own, and averages as papers print them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.fakes import Worlds
from vecenv_eval.campaign import CAMPAIGN, Campaign, is_campaign, legs, markdown
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.merge import merge
from vecenv_eval.report.run import read_run
from vecenv_eval.store import ResultStore, StoreError


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


def test_a_repeated_command_continues_the_same_campaign_and_no_other(tmp_path: Path) -> None:
    Campaign(config(), tmp_path / "c", Worlds().simulator).run()
    worlds = Worlds()
    Campaign(config(num_envs=3), tmp_path / "c", worlds.simulator).run()
    assert worlds.made == []
    with pytest.raises(StoreError, match=r"another evaluation \(there and here: max_steps not set and 3\)"):
        Campaign(config(max_steps=3), tmp_path / "c", Worlds().simulator).run()


def test_shards_of_a_campaign_are_merged_run_by_run(tmp_path: Path) -> None:
    whole, _ = Campaign(config(seeds="0,7"), tmp_path / "whole", Worlds().simulator).run()
    parts = [tmp_path / "a", tmp_path / "b"]
    for number, folder in enumerate(parts, start=1):
        Campaign(config(seeds="0,7", shard=f"{number}/2"), folder, Worlds().simulator).run()
    half = merge(tmp_path / "merged", parts[:1], simulator=Worlds().simulator)
    assert half.summary is not None
    assert [row.missing for row in half.summary.suites] == [20, 20]
    merged = merge(tmp_path / "merged", parts, simulator=Worlds().simulator)
    assert merged.ok
    assert merged.summary == whole
    for name in ("summary.json", "report.md"):
        assert (tmp_path / "merged" / name).read_text() == (tmp_path / "whole" / name).read_text()
    assert Campaign.open(tmp_path / "merged", Worlds().simulator).run()[0] == whole


def test_a_run_that_no_shard_has_begun_is_missing_in_the_merged_campaign(tmp_path: Path) -> None:
    first = Campaign(config(shard="1/2"), tmp_path / "a", Worlds().simulator)
    first.legs = first.legs[:1]
    first.run()
    merged = merge(tmp_path / "merged", [tmp_path / "a"], simulator=Worlds().simulator)
    assert not merged.ok
    assert [result.summary.total.missing for result in merged.results] == [10, 20]
    summary, results = Campaign.open(tmp_path / "merged", Worlds().simulator).run()
    assert all(result.ok for result in results)
    assert [row.episodes for row in summary.suites] == [20, 20]


def test_a_campaign_and_a_single_run_are_not_merged(tmp_path: Path) -> None:
    Campaign(config(), tmp_path / "a", Worlds().simulator).run()
    with pytest.raises(StoreError, match=r"holds several suites or seeds, .*libero_goal does not"):
        merge(tmp_path / "merged", [tmp_path / "a", tmp_path / "a" / "libero_goal"], simulator=Worlds().simulator)
    Campaign(config(seeds="1,2"), tmp_path / "b", Worlds().simulator).run()
    with pytest.raises(StoreError, match="not from one evaluation: seeds not set and '1,2'"):
        merge(tmp_path / "merged", [tmp_path / "a", tmp_path / "b"], simulator=Worlds().simulator)
