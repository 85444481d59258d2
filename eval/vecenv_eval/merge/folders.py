"""The rows, runs and summaries of several results folders in one.

A verdict counts rather than an error; two different verdicts for one episode are an error. What was recorded comes
first and the rows last, so that an episode with a row in the merged folder has everything, and a merge that was
interrupted is completed by repeating it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vecenv_eval.campaign import CAMPAIGN, Campaign, CampaignSummary, legs, read_campaign, write_campaign
from vecenv_eval.conditions import stored_as
from vecenv_eval.config import EvalConfig, differences
from vecenv_eval.episodes import Episode
from vecenv_eval.merge.artifacts import copy_artifacts
from vecenv_eval.merge.sources import Source, check_alike, read_source
from vecenv_eval.results import EvalResult, open_or_begin, write_results
from vecenv_eval.runner import chosen_episodes
from vecenv_eval.simulator import Simulator, vecenv_simulator
from vecenv_eval.store import CONFIG, Record, StoreError


@dataclass(frozen=True, kw_only=True)
class Merged:
    """A merged folder.

    Attributes:
        folder: where it is.
        results: of each run of a campaign, suite by suite; of one evaluation, the only one.
        summary: of a campaign, its numbers; else None.
    """

    folder: Path
    results: tuple[EvalResult, ...]
    summary: CampaignSummary | None = None

    @property
    def ok(self) -> bool:
        """Every planned episode has a verdict."""
        return all(result.ok for result in self.results)


def merge(
    out: Path, folders: Sequence[Path], *, any_versions: bool = False, simulator: Simulator | None = None
) -> Merged:
    """Join results folders of one evaluation, or of one campaign.

    Args:
        out: the merged folder; one that is there from an earlier merge is added to.
        folders: what to join, at least one. They are not changed, and runs may be writing to them.
        any_versions: join runs under different versions of simulators and numeric packages too.
        simulator: what knows the suites, ``vecenv`` when not given.

    Raises:
        StoreError: the folders are not from one evaluation, are damaged, or hold different verdicts for one episode;
            or something else is at ``out``.
    """
    if not folders:
        raise StoreError("no results folder to merge is named")
    if out.resolve() in {folder.resolve() for folder in folders}:
        raise StoreError(f"{out} is to be merged into itself: name another folder for the result")
    campaigns = [folder for folder in folders if (folder / CAMPAIGN).is_file()]
    if campaigns and len(campaigns) < len(folders):
        other = next(folder for folder in folders if folder not in campaigns)
        raise StoreError(f"{campaigns[0]} holds several suites or seeds, {other} does not: merge one kind at a time")
    simulator = simulator or vecenv_simulator()
    if campaigns:
        return _merge_campaigns(out, folders, any_versions, simulator)
    sources = [read_source(folder) for folder in folders]
    result = _merge_one(out, replace(sources[0].config, shard=None), sources, any_versions, simulator)
    return Merged(folder=out, results=(result,))


def _merge_campaigns(out: Path, folders: Sequence[Path], any_versions: bool, simulator: Simulator) -> Merged:
    """Merge run by run; a run that no folder has begun is there with all its episodes missing."""
    configs = [read_campaign(folder) for folder in folders]
    for folder, config in zip(folders[1:], configs[1:], strict=True):
        if different := differences(configs[0], config):
            raise StoreError(f"{folders[0]} and {folder} are not from one evaluation: {', '.join(different)}")
    whole = Campaign(replace(configs[0], shard=None), out, simulator, checked=False)
    parts = [legs(config, folder) for config, folder in zip(configs, folders, strict=True)]
    found = [
        [read_source(part[number].folder) for part in parts if (part[number].folder / CONFIG).is_file()]
        for number in range(len(whole.legs))
    ]
    for leg, sources in zip(whole.legs, found, strict=True):
        _check(leg.folder, sources, any_versions)
    write_campaign(whole.config, out)
    results = [
        _merge_one(leg.folder, leg.config, sources, any_versions, simulator)
        for leg, sources in zip(whole.legs, found, strict=True)
    ]
    return Merged(folder=out, results=tuple(results), summary=whole.write_summary(results))


def _check(out: Path, sources: Sequence[Source], any_versions: bool) -> list[Source]:
    """Refuse what does not belong together; gives the merged folder, if it is there already, and the sources."""
    there = [read_source(out)] if (out / CONFIG).is_file() else []
    if there and there[0].config.shard is not None:
        raise StoreError(f"{out} is shard {there[0].config.shard} of an evaluation: name another folder for the result")
    every = [*there, *sources]
    check_alike(every, versions=not any_versions)
    return every


def _merge_one(
    out: Path, config: EvalConfig, sources: Sequence[Source], any_versions: bool, simulator: Simulator
) -> EvalResult:
    """Merge the folders of one evaluation.

    Args:
        out: the merged folder.
        config: what the whole evaluates.
        sources: the folders, none of them ``out``.
        any_versions: versions may differ.
        simulator: what knows the suite.
    """
    every = _check(out, sources, any_versions)
    suite = simulator.suite_of(config)
    _, episodes = chosen_episodes(config, suite)
    planned = [Episode(suite.name, task, episode) for task, some in episodes.items() for episode in some]
    _join(every, frozenset(planned))  # refuses what does not fit before a folder is made
    if (out / CONFIG).is_file():
        config = replace(config, store=every[0].config.store)
    store = open_or_begin(config, out)
    with store.writing():
        merged = read_source(out)  # as it is now that nobody else writes
        joined = _join([merged, *sources], frozenset(planned))
        new = {key: source for key, (_, source) in joined.items() if source is not merged}
        copy_artifacts(store, new)
        runs, numbers = _join_runs(merged, sources)
        content = {**merged.content, **_from_any(every), "runs": runs}
        conditions = next((source.conditions for source in every if source.conditions), None)
        if conditions is not None:
            content["conditions"] = conditions | stored_as(config, store.rows.describe())
        store.write_config(content)
        store.append(_renumbered(*joined[key], numbers) for key in planned if key in new)
        store.close()
        return write_results(store, suite, planned, content.get("policy_name") or config.policy_name)


def _join(sources: Sequence[Source], planned: Collection[Episode]) -> dict[Episode, tuple[Record, Source]]:
    """The record that counts of each episode, and where it is from.

    Raises:
        StoreError: an episode that is not planned, or two different verdicts for one.
    """
    joined: dict[Episode, tuple[Record, Source]] = {}
    for source in sources:
        for key, record in source.records.items():
            if key not in planned:
                raise StoreError(f"{source.folder} has episode {key.id}, which is not part of the evaluation")
            other, where = joined.get(key, (None, source))
            if other is None or (other.error and not record.error):
                joined[key] = record, source
            elif not other.error and not record.error and other.verdict != record.verdict:
                ours, theirs = other.verdict, record.verdict
                different = [name for name in ours if ours[name] != theirs[name]]
                raise StoreError(
                    f"episode {key.id} has two different verdicts, in {where.folder} and in {source.folder}: "
                    + ", ".join(f"{name} {ours[name]!r} and {theirs[name]!r}" for name in different)
                )
    return joined


def _from_any(sources: Sequence[Source]) -> dict[str, Any]:
    """The policy's own name, which a folder knows once a run has begun."""
    names = [source.content["policy_name"] for source in sources if "policy_name" in source.content]
    return {"policy_name": names[0]} if names else {}


def _join_runs(merged: Source, sources: Sequence[Source]) -> tuple[list[dict[str, Any]], dict[Path, list[int]]]:
    """The runs of all folders, each once, and for each source folder the numbers that its runs have now."""
    runs = list(merged.runs)
    numbers = {identity: number for number, identity in enumerate(_identities(merged))}
    of_folder: dict[Path, list[int]] = {}
    for source in sources:
        for run, identity in zip(source.runs, _identities(source), strict=True):
            if identity not in numbers:
                numbers[identity] = len(runs)
                runs.append({"folder_id": identity[0], "shard": source.config.shard} | run)
            of_folder.setdefault(source.folder, []).append(numbers[identity])
    return runs, of_folder


def _identities(source: Source) -> list[tuple[str, int]]:
    """Each run's folder, by its id, and which run on that folder it is; runs are only ever added."""
    counts: dict[str, int] = {}
    found = []
    for run in source.runs:
        folder = str(run.get("folder_id", source.id))
        found.append((folder, counts.get(folder, 0)))
        counts[folder] = counts.get(folder, 0) + 1
    return found


def _renumbered(record: Record, source: Source, numbers: Mapping[Path, Sequence[int]]) -> Record:
    """A record with the number that its run has in the merged folder."""
    known = numbers.get(source.folder, ())
    if not 0 <= record.run < len(known):
        raise StoreError(f"{source.folder}: episode {record.key.id} is of run {record.run}, but there are {len(known)}")
    return replace(record, run=known[record.run])
