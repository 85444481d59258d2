"""The page of ``vecenv report``: one HTML file that needs no other and asks no server for anything.

One or two :class:`~vecenv_eval.report.run.Run` come in; text goes out. Everything that comes from a results folder is
escaped by the template, and the page's own policy (Content-Security-Policy) forbids requests. Videos are put into the
page up to a total size, and beyond it linked beside it.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from vecenv.errors import MissingDependency
from vecenv_eval.report import figures
from vecenv_eval.report.compare import compare
from vecenv_eval.report.findings import conditions, last_actions, plain, video_of, warnings
from vecenv_eval.report.run import Run, SuiteRun
from vecenv_eval.report.summary import Row
from vecenv_eval.report.tables import PARTS, part_cells
from vecenv_eval.store import Record
from vecenv_eval.store.files import read_regular

TEMPLATE = "page.html.j2"
EMBED_MB = 20.0
# Failed episodes that are shown one by one; of the others there is a table.
MOST_SHOWN = 200


@dataclass(frozen=True, kw_only=True)
class EpisodeView:
    """One episode as the page shows it.

    Attributes:
        record: how it went.
        outcome: ``error``, ``fault``, ``failed`` or ``solved``.
        cause: why, "" where nobody says.
        video: address of its video, "" without one.
        embedded: the address holds the video itself.
        actions: its last actions, oldest first.
        extras: what the policy reported.
    """

    record: Record
    outcome: str
    cause: str
    video: str = ""
    embedded: bool = False
    actions: Sequence[Sequence[float]] = ()
    extras: Mapping[str, str] = field(default_factory=dict)


def page(run: Run, other: Run | None = None, *, out: Path, embed_mb: float = EMBED_MB) -> str:
    """The page about a run, and how another compares on the same episodes.

    Args:
        run, other: the runs.
        out: where the page will be written; linked videos are relative to it.
        embed_mb: most megabytes of videos inside the page.

    Raises:
        MissingDependency: jinja2 or plotly is not installed.
    """
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
        from markupsafe import Markup
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise MissingDependency(f"the page needs {error.name}: pip install 'vecenv[eval]'") from None

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"percent": _percent, "interval": _interval, "plain": plain, "part_cells": part_cells}
    views = _views(run, out.parent, embed_mb)
    failed = [view for view in views if view.outcome != "solved"]
    return environment.get_template(TEMPLATE).render(
        run=run,
        other=other,
        warnings=warnings(run),
        conditions=conditions(run),
        versions=_versions(run),
        failed=failed[:MOST_SHOWN],
        hidden=len(failed) - len(failed[:MOST_SHOWN]),
        parts_title=PARTS,
        solved=[view for view in views if view.outcome == "solved"],
        final="final" in {suite.settings("conditions").get("success") for suite in run.suites},
        comparison=None if other is None else compare(run, other),
        figures=_figures(run, other),
        plotly_js=Markup(get_plotlyjs()),  # nosec B704 # a file of the plotly package
    )


def _figures(run: Run, other: Run | None) -> dict[str, figures.Figure]:
    """Charts by the id of the element that shows them."""
    others = {suite.suite: suite for suite in other.suites} if other else {}
    names = (run.name, other.name if other else "")
    found = {
        f"tasks-{index}": figures.success_by_task(suite, others.get(suite.suite), names)
        for index, suite in enumerate(run.suites)
    }
    found["ticks"] = figures.success_over_ticks([run, other] if other else [run])
    budget = figures.time_budget(run)
    return found if budget is None else found | {"time": budget}


def _views(run: Run, beside: Path, embed_mb: float) -> list[EpisodeView]:
    """Every episode: errors and faults first, then failures, then what was solved."""
    room, order = embed_mb * 2**20, ("error", "fault", "failed", "solved")
    pairs = [(suite, record) for suite in run.suites for record in suite.records]
    pairs.sort(key=lambda pair: order.index(_outcome(pair[1])))
    views = []
    for suite, record in pairs:
        view, used = _view(suite, record, beside, room)
        views.append(view)
        room -= used
    return views


def _view(suite: SuiteRun, record: Record, beside: Path, room: float) -> tuple[EpisodeView, int]:
    """One episode, and how many bytes of videos it takes of the room that is left."""
    outcome, path, used = _outcome(record), video_of(suite, record), 0
    video = ""
    if path is not None and path.stat().st_size <= room:
        used = path.stat().st_size
        video = "data:video/mp4;base64," + base64.b64encode(read_regular(path)).decode()
    elif path is not None:
        video = quote(os.path.relpath(path.resolve(), beside.resolve()).replace(os.sep, "/"))
    return EpisodeView(
        record=record,
        outcome=outcome,
        cause=record.error or record.fault or str(record.extras.get("cause") or ""),
        video=video,
        embedded=used > 0,
        actions=() if outcome == "solved" else last_actions(suite, record),
        extras={str(name): plain(value) for name, value in record.extras.items() if value not in (None, "")},
    ), used


def _outcome(record: Record) -> str:
    if record.error:
        return "error"
    return "fault" if record.fault else "solved" if record.success else "failed"


def _versions(run: Run) -> list[tuple[str, str]]:
    """Every version on record, from the last run on each folder."""
    found: dict[str, dict[str, None]] = {}
    for suite in run.suites:
        versions: Any = suite.runs[-1].get("versions") if suite.runs else None
        for name, version in versions.items() if isinstance(versions, Mapping) else ():
            found.setdefault(str(name), {})[str(version)] = None
    return [(name, " / ".join(versions)) for name, versions in found.items()]


def _percent(rate: float | None) -> str:
    return "-" if rate is None else f"{rate:.1%}"


def _interval(row: Row) -> str:
    return "-" if row.low is None or row.high is None else f"{row.low:.1%} to {row.high:.1%}"
