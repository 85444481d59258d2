"""Two runs on the same episodes: who solves more, and whether chance explains it.

Two :class:`~vecenv_eval.report.run.Run` come in; a :class:`Comparison` goes out. Episodes are paired by suite, task and
number; McNemar's exact test looks at the pairs of which one run solved its episode and the other did not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from scipy.stats import binomtest

from vecenv_eval.episodes import Episode
from vecenv_eval.report.findings import plain
from vecenv_eval.report.run import Run
from vecenv_eval.store import Record


@dataclass(frozen=True, kw_only=True)
class Pair:
    """One episode in both runs."""

    episode: Episode
    first: Record
    second: Record


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """How two runs compare on the episodes that both have a verdict about.

    Attributes:
        first, second: names of the runs.
        both, neither: episodes that both solved, and that none did.
        lost: pairs that the first run solved and the second did not.
        won: the other way round.
        unpaired: episodes with a verdict in one run only.
        p_value: of McNemar's exact test, two-sided: the chance of a difference at least this large between two runs
            that are equally good.
        differences: conditions that differ, name -> (the first run's, the second's).
    """

    first: str
    second: str
    both: int
    neither: int
    lost: tuple[Pair, ...]
    won: tuple[Pair, ...]
    unpaired: int
    p_value: float
    differences: Mapping[str, tuple[str, str]]

    @property
    def episodes(self) -> int:
        """How many pairs there are."""
        return self.both + self.neither + len(self.lost) + len(self.won)

    @property
    def rates(self) -> tuple[float, float] | None:
        """Success rates of both runs on the pairs; None without any."""
        if not self.episodes:
            return None
        return (self.both + len(self.lost)) / self.episodes, (self.both + len(self.won)) / self.episodes

    @property
    def sentence(self) -> str:
        """The result in words."""
        if self.rates is None:
            return f"{self.first} and {self.second} have no episode in common."
        one, two = self.rates
        return (
            f"On {self.episodes} episodes that both have a verdict about, {self.first} solved {one:.1%} and "
            f"{self.second} {two:.1%} ({100 * (two - one):+.1f} points). {len(self.lost)} went from solved to failed, "
            f"{len(self.won)} from failed to solved; McNemar's exact test: p = {self.p_value:.2g}."
        )


def mcnemar(lost: int, won: int) -> float:
    """Two-sided p-value of McNemar's exact test, from the numbers of pairs that changed sides either way."""
    return float(binomtest(lost, lost + won, 0.5).pvalue) if lost + won else 1.0


def compare(first: Run, second: Run) -> Comparison:
    """Pair the episodes of two runs; those without a verdict in one of them are left out."""
    ours, theirs = _verdicts(first), _verdicts(second)
    pairs = [Pair(episode=key, first=ours[key], second=theirs[key]) for key in sorted(ours.keys() & theirs.keys())]
    lost = tuple(pair for pair in pairs if pair.first.success and not pair.second.success)
    won = tuple(pair for pair in pairs if pair.second.success and not pair.first.success)
    both = sum(bool(pair.first.success and pair.second.success) for pair in pairs)
    names = (first.name, second.name) if first.name != second.name else (str(first.folder), str(second.folder))
    return Comparison(
        first=names[0],
        second=names[1],
        both=both,
        neither=len(pairs) - both - len(lost) - len(won),
        lost=lost,
        won=won,
        unpaired=len(ours.keys() ^ theirs.keys()),
        p_value=mcnemar(len(lost), len(won)),
        differences=_differences(_conditions(first), _conditions(second)),
    )


def _verdicts(run: Run) -> dict[Episode, Record]:
    return {key: record for key, record in run.records.items() if not record.error}


def _conditions(run: Run) -> dict[str, dict[str, Any]]:
    """Of each suite, what its success rate depends on."""
    return {
        suite.suite: {
            "policy": suite.policy,
            **{
                name: suite.settings("config").get(name) for name in ("policy_args", "backend", "env_args", "max_steps")
            },
            **{name: value for name, value in suite.settings("conditions").items() if name != "instead"},
        }
        for suite in run.suites
    }


def _differences(
    ours: Mapping[str, dict[str, Any]], theirs: Mapping[str, dict[str, Any]]
) -> dict[str, tuple[str, str]]:
    """Conditions that differ, of the suites that both have; named with the suite where there are several."""
    found = {}
    shared = [suite for suite in ours if suite in theirs]
    for suite in shared:
        for name in ours[suite] | theirs[suite]:
            one, two = ours[suite].get(name), theirs[suite].get(name)
            if one != two:
                found[f"{suite}: {name}" if len(shared) > 1 else name] = (plain(one), plain(two))
    return found
