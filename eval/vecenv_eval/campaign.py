"""Several suites and several seeds as one evaluation, averaged as papers print it.

An ``EvalConfig`` that names more than one suite or seed comes in. Each pair of suite and seed is a run of its own, with
a results folder of its own inside the campaign's (``DIR/libero_goal``, or ``DIR/seed-1/libero_goal``), so everything
that reads a results folder reads each of them. Out: :class:`CampaignSummary`, also ``summary.json`` and ``report.md``.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from vecenv.util.tables import Column, FittedTable
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.engine import engine_class
from vecenv_eval.results import CAMPAIGN, EvalResult, Progress, changed, open_or_begin, refuse_other_settings
from vecenv_eval.runner import Evaluation, check
from vecenv_eval.simulator import Simulator, vecenv_simulator
from vecenv_eval.store import REPORT, SUMMARY, ResultStore, StoreError
from vecenv_eval.store.files import read_json, replace_text

_OVER_SEEDS = "Success: mean and sample standard deviation over seeds."


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One run of a campaign.

    Attributes:
        suite: its suite.
        seed: its seed, None for the protocol's.
        config: what is evaluated.
        folder: its results folder.
    """

    suite: str
    seed: int | None
    config: EvalConfig
    folder: Path


@dataclass(frozen=True, kw_only=True)
class SuiteRow:
    """A suite's success over its seeds, as shares of its episodes.

    Attributes:
        suite: the suite.
        rates: of each seed, None where no episode has a verdict.
        mean: of the rates, None without any.
        std: their sample standard deviation, None with fewer than two.
        episodes: episodes with a verdict, all seeds together.
        errors, missing: episodes without one.
    """

    suite: str
    rates: tuple[float | None, ...]
    mean: float | None
    std: float | None
    episodes: int
    errors: int
    missing: int


@dataclass(frozen=True, kw_only=True)
class CampaignSummary:
    """A campaign in numbers.

    Attributes:
        policy: what was evaluated.
        seeds: the seeds, None for the protocol's.
        suites: one row a suite.
        average: mean over suites of the mean over seeds, each suite counting once; None while one has no verdict.
        average_std: sample standard deviation over seeds of that average, None with fewer than two seeds.
    """

    policy: str
    seeds: tuple[int | None, ...]
    suites: tuple[SuiteRow, ...]
    average: float | None
    average_std: float | None


def is_campaign(config: EvalConfig) -> bool:
    """Whether a config asks for more than one run."""
    return len(config.suites) > 1 or config.seeds is not None


def legs(config: EvalConfig, folder: Path) -> list[Leg]:
    """The runs of a campaign, suite by suite.

    Raises:
        ConfigError: no suite, or seeds that are none.
    """
    if not config.suites:
        raise ConfigError("no suite is named")
    made = []
    for suite in config.suites:
        for seed in config.all_seeds:
            own = replace(config, suite=suite, seed=seed, seeds=None)
            place = folder / f"seed-{seed}" if config.seeds else folder
            made.append(Leg(suite=suite, seed=seed, config=own, folder=place / suite.replace("/", "-")))
    return made


class Campaign:
    """The runs of a config that names several suites or seeds; making one checks every run's settings.

    Args:
        config: what to evaluate.
        folder: the results folder of the whole.
        simulator: where environments come from, ``vecenv`` when not given.
        checked: check the settings; not needed where nothing is to be run.

    Attributes:
        legs: the runs.
        num_episodes: how many episodes each run has.

    Raises:
        ConfigError, SpecError, PolicyError: something in the config does not exist or does not fit.
    """

    def __init__(
        self, config: EvalConfig, folder: Path, simulator: Simulator | None = None, *, checked: bool = True
    ) -> None:
        self.config, self.folder, self._simulator = config, folder, simulator
        self.legs = legs(config, folder)
        self.num_episodes = []
        for leg in self.legs if checked else ():
            _, _, episodes = check(leg.config, simulator or vecenv_simulator())
            self.num_episodes.append(sum(map(len, episodes.values())))

    @classmethod
    def open(cls, folder: Path, simulator: Simulator | None = None, **changes: Any) -> Campaign:
        """A campaign that is continued.

        Args:
            folder: its folder.
            simulator: where environments come from, ``vecenv`` when not given.
            **changes: as for ``vecenv_eval.results.resume``.

        Raises:
            ConfigError: something has to be given again, or is not what the folder has.
            StoreError: the folder holds none.
        """
        return cls(changed(read_campaign(folder), changes, folder), folder, simulator)

    def run(
        self,
        on_progress: Callable[[Leg, Progress], None] = lambda leg, progress: None,
        on_result: Callable[[Leg, EvalResult], None] = lambda leg, result: None,
        on_begin: Callable[[Leg, ResultStore], None] = lambda leg, store: None,
    ) -> tuple[CampaignSummary, list[EvalResult]]:
        """Run what has no verdict yet, run by run; Ctrl-C ends it with what was computed.

        Raises:
            StoreError: something is in the way, or the folder holds a campaign with other settings.
        """
        write_campaign(self.config, self.folder)
        results: list[EvalResult] = []
        summary = summarise((), ())
        with engine_class(self.config).shared():
            for leg in self.legs:
                store = open_or_begin(leg.config, leg.folder)
                on_begin(leg, store)

                def report(progress: Progress, leg: Leg = leg) -> None:
                    on_progress(leg, progress)

                result = Evaluation(leg.config, self._simulator).run(store, report)
                results.append(result)
                on_result(leg, result)
                summary = self.write_summary(results)
                if result.interrupted:
                    break
        return summary, results

    def write_summary(self, results: Sequence[EvalResult]) -> CampaignSummary:
        """Write ``summary.json`` and ``report.md`` of the first runs, and return their numbers."""
        summary = summarise(self.legs[: len(results)], results)
        replace_text(self.folder / SUMMARY, json.dumps(asdict(summary), indent=2) + "\n")
        replace_text(self.folder / REPORT, markdown(summary))
        return summary


def read_campaign(folder: Path) -> EvalConfig:
    """The config of a campaign's folder.

    Raises:
        StoreError: the folder holds none.
    """
    try:
        return EvalConfig.from_dict(read_json(folder / CAMPAIGN))
    except StoreError:
        raise
    except (OSError, ValueError, TypeError) as error:
        raise StoreError(f"{folder / CAMPAIGN} cannot be read: {error}") from None


def write_campaign(config: EvalConfig, folder: Path) -> None:
    """Make the folder of a campaign, unless it is there.

    Raises:
        StoreError: there is something else, or a campaign with other settings.
    """
    if (folder / CAMPAIGN).exists():
        refuse_other_settings(config, read_campaign(folder), folder)
        return
    if folder.exists() and (not folder.is_dir() or any(path.name != f"{CAMPAIGN}.tmp" for path in folder.iterdir())):
        raise StoreError(f"{folder} is already there and not empty: name another, or use --resume")
    folder.mkdir(parents=True, exist_ok=True)
    replace_text(folder / CAMPAIGN, json.dumps(config.to_dict(), indent=2) + "\n")


def summarise(run: Sequence[Leg], results: Sequence[EvalResult]) -> CampaignSummary:
    """The numbers of the runs that there are."""
    by_suite: dict[str, list[EvalResult]] = {}
    for leg, result in zip(run, results, strict=True):
        by_suite.setdefault(leg.suite, []).append(result)
    rows = tuple(_row(suite, some) for suite, some in by_suite.items())
    means = [row.mean for row in rows]
    seeds = tuple(dict.fromkeys(leg.seed for leg in run))
    per_seed = [_mean([row.rates[index] for row in rows if index < len(row.rates)]) for index in range(len(seeds))]
    return CampaignSummary(
        policy=results[0].summary.policy if results else "",
        seeds=seeds,
        suites=rows,
        average=_mean(means),
        average_std=_std(per_seed),
    )


def _row(suite: str, results: Sequence[EvalResult]) -> SuiteRow:
    totals = [result.summary.total for result in results]
    rates = tuple(total.rate for total in totals)
    return SuiteRow(
        suite=suite,
        rates=rates,
        mean=_mean(rates),
        std=_std(rates),
        episodes=sum(total.episodes for total in totals),
        errors=sum(total.errors for total in totals),
        missing=sum(total.missing for total in totals),
    )


def _mean(values: Sequence[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return math.fsum(there) / len(there) if there and len(there) == len(values) else None


def _std(values: Sequence[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return statistics.stdev(there) if len(there) > 1 else None


def table(summary: CampaignSummary) -> FittedTable:
    """The table for the screen: a row a suite, and the average over suites."""
    head, rows = _cells(summary)
    columns = [Column(name, key=name == "suite", justify="left" if name == "suite" else "right") for name in head]
    several = len(summary.seeds) > 1
    return FittedTable(
        columns=columns, rows=rows, title=summary.policy, caption=_OVER_SEEDS if several else "", total=True
    )


def markdown(summary: CampaignSummary) -> str:
    """The same table for ``report.md``."""
    head, rows = _cells(summary)
    lines = [f"# {summary.policy}", "", _line(head), _line(["---"] * len(head)), *map(_line, rows)]
    if len(summary.seeds) > 1:
        lines += ["", _OVER_SEEDS]
    return "\n".join(lines) + "\n"


def _cells(summary: CampaignSummary) -> tuple[list[str], list[list[str]]]:
    """Headings and rows, the last of which is the average."""
    seeds = summary.seeds if len(summary.seeds) > 1 else ()
    head = ["suite", "success", *(f"seed {seed}" for seed in seeds), "episodes", "no verdict"]
    rows = []
    for row in summary.suites:
        each = [_percent(rate) for rate in row.rates[: len(seeds)]]
        each += ["-"] * (len(seeds) - len(each))
        rows.append([row.suite, _spread(row.mean, row.std), *each, str(row.episodes), str(row.errors + row.missing)])
    average = ["average over suites", _spread(summary.average, summary.average_std)]
    return head, [*rows, [*average, *[""] * (len(head) - 2)]]


def _line(cells: Sequence[Any]) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def _percent(rate: float | None) -> str:
    return "-" if rate is None else f"{100 * rate:.1f}%"


def _spread(mean: float | None, std: float | None) -> str:
    return _percent(mean) if std is None else f"{_percent(mean)} ± {100 * std:.1f}"
