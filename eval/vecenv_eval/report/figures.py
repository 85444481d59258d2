"""The charts of a report, as plain plotly figures: ``{"data": [...], "layout": {...}}``.

One or two :class:`~vecenv_eval.report.run.Run` come in. Colours of text, axes and background are left to the page,
which knows whether it is light or dark.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, TypeAlias

import numpy as np

from vecenv_eval.report.run import Run, SuiteRun

Figure: TypeAlias = dict[str, Any]
# Readable on white and on black, and told apart by those who see few colours (after Okabe and Ito).
COLORS = ("#2a8fd8", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
# Where the seconds of an episode go, by field of a record.
PARTS = {"policy_s": "policy", "physics_s": "physics", "images_s": "images"}
_ROW, _HEAD = 24, 90


def success_by_task(suite: SuiteRun, other: SuiteRun | None = None, names: Sequence[str] = ("", "")) -> Figure:
    """Success rate of each task with its interval; with those of the same suite in another run beside it."""
    data = [
        _rates(each, escape(names[index]), COLORS[index], ("circle", "diamond")[index])
        for index, each in enumerate((suite, other))
        if each is not None
    ]
    tasks = len({name for trace in data for name in trace["y"]})
    layout = _layout(_HEAD + _ROW * tasks * len(data), "success, %")
    layout["xaxis"]["range"] = [-2, 102]
    layout["yaxis"] = {"autorange": "reversed", "automargin": True, "type": "category"}
    return {"data": data, "layout": layout | {"showlegend": len(data) > 1, "scattermode": "group", "scattergap": 0.4}}


def _rates(suite: SuiteRun, name: str, color: str, symbol: str) -> Figure:
    """The trace of a suite's tasks: dots with intervals."""
    rows = [row for row in suite.summary.tasks if row.rate is not None]
    low, rate, high = np.array([(row.low, row.rate, row.high) for row in rows], float).reshape(-1, 3).T * 100
    return {
        "type": "scatter",
        "mode": "markers",
        "orientation": "h",
        "name": name,
        "x": rate.tolist(),
        "y": [f"task {row.task}" for row in rows],
        "error_x": {
            "type": "data",
            "symmetric": False,
            "array": (high - rate).tolist(),
            "arrayminus": (rate - low).tolist(),
        },
        "marker": {"size": 9, "color": color, "symbol": symbol},
        "text": [f"{escape(row.instruction)}<br>{row.successes}/{row.episodes}" for row in rows],
        "hovertemplate": "%{text}<br>%{x:.1f} %<extra></extra>",
    }


def success_over_ticks(runs: Sequence[Run]) -> Figure:
    """The share of episodes that were solved within so many control ticks, a line for each suite and run."""
    data = []
    for dash, run in zip(("solid", "dash"), runs, strict=False):
        for index, suite in enumerate(run.suites):
            ticks, share = solved_within(suite)
            if len(ticks):
                name = f"{suite.title} ({run.name})" if len(runs) > 1 else suite.title
                data.append(
                    {
                        "type": "scatter",
                        "mode": "lines",
                        "name": escape(name),
                        "x": ticks.tolist(),
                        "y": (100 * share).tolist(),
                        "line": {"shape": "hv", "dash": dash, "width": 2, "color": COLORS[index % len(COLORS)]},
                        "hovertemplate": "%{y:.1f} % within %{x} ticks<extra></extra>",
                    }
                )
    layout = _layout(360, "control ticks")
    layout["yaxis"] = {"title": {"text": "solved, %"}, "range": [-2, 102], "automargin": True}
    return {"data": data, "layout": layout | {"showlegend": len(data) > 1}}


def solved_within(suite: SuiteRun) -> tuple[np.ndarray, np.ndarray]:
    """Ticks, int [N], and the share of episodes with a verdict that were solved within them, [N]."""
    verdicts = [record for record in suite.records if not record.error]
    if not verdicts:
        return np.zeros(0, int), np.zeros(0)
    solved = np.array([record.num_steps for record in verdicts if record.success], int)
    ticks = np.unique(np.concatenate([[0], solved, [max(record.num_steps for record in verdicts)]]))
    return ticks, (solved[:, None] <= ticks).sum(axis=0) / len(verdicts)


def seconds(suite: SuiteRun) -> Mapping[str, float]:
    """Seconds that episodes spent in each part, summed over them; empty where none were recorded."""
    found = {name: float(sum(getattr(record, field) for record in suite.records)) for field, name in PARTS.items()}
    return {name: value for name, value in found.items() if value > 0}


def time_budget(run: Run) -> Figure | None:
    """The parts' shares of each suite's time; None where none were recorded."""
    spent = {suite.title: seconds(suite) for suite in run.suites}
    spent = {title: parts for title, parts in spent.items() if parts}
    if not spent:
        return None
    data = []
    for index, part in enumerate(PARTS.values()):
        values = [parts.get(part, 0.0) for parts in spent.values()]
        totals = [sum(parts.values()) for parts in spent.values()]
        data.append(
            {
                "type": "bar",
                "orientation": "h",
                "name": part,
                "y": [escape(title) for title in spent],
                "x": [100 * value / total for value, total in zip(values, totals, strict=True)],
                "text": [f"{value:,.1f} s" for value in values],
                "marker": {"color": COLORS[index]},
                "hovertemplate": f"{part}: %{{text}}, %{{x:.1f}} %<extra></extra>",
            }
        )
    layout = _layout(_HEAD + 44 * len(spent), "share of the time measured, %")
    layout["yaxis"] = {"autorange": "reversed", "automargin": True, "type": "category"}
    return {"data": data, "layout": layout | {"barmode": "stack", "showlegend": True}}


def _layout(height: int, x: str) -> Figure:
    return {
        "height": height,
        "margin": {"l": 50, "r": 16, "t": 12, "b": 48},
        "xaxis": {"title": {"text": x}, "automargin": True},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"},
        "dragmode": False,
    }
