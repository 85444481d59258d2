"""What ``vecenv eval --json`` prints: one JSON object a line, each of one of the kinds below.

The schema is these classes: ``EVENTS.json_schema()`` writes it as JSON Schema, docs/watching.md as a table. Within one
``schema`` number, fields and events may be added, none is renamed or removed. Numbers that are not finite become null.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, TypeAdapter

SCHEMA = 1


class _Event(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="null")

    def line(self) -> str:
        """The event as a line of JSON, without the newline."""
        return self.model_dump_json()


class Run(_Event):
    """One run: a suite with a seed (null: the protocol's), its results folder, and how many episodes it has."""

    suite: str
    seed: int | None
    folder: str
    episodes: int


class Start(_Event):
    """The first event, once settings have been checked: ``config`` has every setting, ``runs`` what will run."""

    event: Literal["start"] = "start"
    schema_version: int = SCHEMA
    version: str
    folder: str
    config: Mapping[str, Any]
    runs: tuple[Run, ...]


class Conditions(_Event):
    """What the episodes of a run are about to run under, as in ``config.json``."""

    event: Literal["conditions"] = "conditions"
    suite: str
    seed: int | None
    conditions: Mapping[str, Any]


class ProgressEvent(_Event):
    """Where a run stands; at most once a second, and once at its end.

    ``done`` of ``total`` episodes have a verdict (those of earlier runs on the folder included), ``successes`` were
    solved, ``faults`` faulted; ``errors`` have no verdict. Rates are null before the first episode has ended.
    """

    event: Literal["progress"] = "progress"
    suite: str
    seed: int | None
    total: int
    done: int
    successes: int
    faults: int
    errors: int
    success_rate: float | None
    episodes_per_s: float | None
    steps_per_s: float
    seconds_left: float | None
    stream: int
    num_streams: int
    setting_up: bool


class EpisodeEvent(_Event):
    """An episode has ended: its row of ``episodes.jsonl``. After an error it may come again (``--retries``)."""

    event: Literal["episode"] = "episode"
    suite: str
    seed: int | None
    record: Mapping[str, Any]


class ErrorEvent(_Event):
    """Something failed: what a stream of episodes raised, or why nothing could run. Also a line on standard error."""

    event: Literal["error"] = "error"
    message: str
    suite: str | None = None
    seed: int | None = None


class SummaryEvent(_Event):
    """A run has ended: its ``summary.json``. ``complete``: every episode has a verdict."""

    event: Literal["summary"] = "summary"
    suite: str
    seed: int | None
    folder: str
    complete: bool
    interrupted: bool
    summary: Mapping[str, Any]


class CampaignEvent(_Event):
    """Several suites or seeds: the ``summary.json`` of the whole."""

    event: Literal["campaign"] = "campaign"
    summary: Mapping[str, Any]


class End(_Event):
    """The last event: the exit status, and the results folder (null if none was made)."""

    event: Literal["end"] = "end"
    status: int
    folder: str | None


Event: TypeAlias = Start | Conditions | ProgressEvent | EpisodeEvent | ErrorEvent | SummaryEvent | CampaignEvent | End
EVENTS: TypeAdapter[Event] = TypeAdapter(Event)
