"""How an evaluation stands and how it ended, and the results folders that a config begins or resumes.

Records come in as episodes end; :class:`Progress` goes to whoever watches, :class:`EvalResult` to the caller.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vecenv_eval.config import ConfigError, EvalConfig, differences
from vecenv_eval.episodes import Episode, Suite
from vecenv_eval.report import Summary, markdown, summarise
from vecenv_eval.store import CONFIG, Record, ResultStore, StoreError

# Where ``config.json`` has the policy's name, which is known where the policy is made.
POLICY_NAME = "policy_name"
# In the folder of a campaign (``vecenv_eval.campaign``), whose runs have folders below it.
CAMPAIGN = "campaign.json"


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Where an evaluation stands; handed to ``on_progress`` after every call of the policy.

    Attributes:
        total: episodes asked for.
        done: episodes with a verdict, those of earlier runs included.
        successes, faults, errors: among the episodes so far.
        steps: control ticks executed in this run, summed over slots.
        seconds: seconds this run has spent running episodes.
        batch, num_batches: which stream of episodes is running, of how many.
        setting_up: the environment of the stream is being built, or its episodes are being placed.
        ended: the episodes that have ended since the last call, those that ended in an error included.
        conditions: what episodes run under (``vecenv_eval.conditions``); empty until there is an environment.
    """

    total: int
    done: int
    successes: int
    faults: int
    errors: int
    steps: int
    seconds: float
    batch: int
    num_batches: int
    setting_up: bool
    ended: tuple[Record, ...] = ()
    conditions: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class EvalResult:
    """How an evaluation ended.

    Attributes:
        summary: the numbers, also in ``summary.json``.
        records: the record of each episode that ran.
        folder: the results folder.
        interrupted: it was stopped from the keyboard.
        causes: the errors that ended episodes in this run, without repetition.
    """

    summary: Summary
    records: tuple[Record, ...]
    folder: Path
    interrupted: bool
    causes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Every episode has a verdict."""
        return self.summary.complete and not self.interrupted


def begin(config: EvalConfig, folder: Path) -> ResultStore:
    """Open a new results folder for a config.

    Raises:
        StoreError: something is in the way.
    """
    return ResultStore.create(folder, {"config": config.to_dict(), "runs": []})


def open_or_begin(config: EvalConfig, folder: Path) -> ResultStore:
    """The results folder of a config: continued if it is there, so that a command can simply be repeated, else new.

    Raises:
        StoreError: there is something else, or an evaluation with other settings; the message names them.
    """
    if not (folder / CONFIG).is_file():
        return begin(config, folder)
    there, store = resume(folder)
    refuse_other_settings(config, there, folder)
    return store


def refuse_other_settings(config: EvalConfig, there: EvalConfig, folder: Path) -> None:
    """Refuse to continue a folder with settings that it was not begun with.

    Raises:
        StoreError: with the settings that differ.
    """
    other = differences(there, config)
    other += [
        f"{name} {getattr(there, name)!r} and {getattr(config, name)!r}"
        for name in ("store", "shard")
        if getattr(there, name) != getattr(config, name)
    ]
    if other:
        raise StoreError(
            f"{folder} is already there and holds another evaluation (there and here: {', '.join(other)}): "
            "name another folder"
        )


def resume(folder: Path, **changes: Any) -> tuple[EvalConfig, ResultStore]:
    """Open an existing results folder, to run what is missing.

    Args:
        folder: the results folder.
        **changes: fields of ``EvalConfig`` to replace for this run; those that are None stay as they were.

    Raises:
        StoreError: it is not a results folder, or it was written by something else.
    """
    store = ResultStore.open(folder)
    try:
        config = EvalConfig.from_dict(store.config()["config"])
    except (KeyError, TypeError, AttributeError, ConfigError) as error:
        raise StoreError(f"{folder / CONFIG} does not hold an evaluation: {error}") from None
    given = {key: value for key, value in changes.items() if value is not None}
    if given.get("engine", config.engine) != config.engine:  # another engine takes other arguments
        given.setdefault("engine_args", {})
    return replace(config, **given), store


def write_results(
    store: ResultStore,
    suite: Suite,
    planned: Sequence[Episode],
    policy: str,
    *,
    interrupted: bool = False,
    causes: Sequence[str] = (),
) -> EvalResult:
    """Write ``summary.json`` and ``report.md`` of all records in a folder, and return both.

    Args:
        store: the results folder.
        suite: the suite.
        planned: every episode of the evaluation.
        policy: name of the policy.
        interrupted, causes: see `EvalResult`.
    """
    records = store.records()
    summary = summarise(
        records.values(),
        planned,
        suite=suite.name,
        policy=policy,
        instructions=suite.instructions,
        conditions=store.config().get("conditions", {}),
    )
    store.write_summary(summary.to_dict(), markdown(summary))
    return EvalResult(
        summary=summary,
        records=tuple(records[key] for key in planned if key in records),
        folder=store.folder,
        interrupted=interrupted,
        causes=tuple(causes),
    )


def count(records: Iterable[Record]) -> dict[str, int]:
    """The counts of :class:`Progress` among records: done, successes, faults and errors."""
    records = list(records)
    errors = sum(bool(record.error) for record in records)
    return {
        "done": len(records) - errors,
        "successes": sum(record.success for record in records),
        "faults": sum(bool(record.fault) for record in records),
        "errors": errors,
    }


def campaign_of(folder: Path) -> Path | None:
    """The folder of the campaign that a results folder belongs to (``DIR/SUITE`` or ``DIR/seed-0/SUITE``), if any."""
    above = folder.resolve().parents[:2]
    return next((place for place in above if (place / CAMPAIGN).is_file()), None)
