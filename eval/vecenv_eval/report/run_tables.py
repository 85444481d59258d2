"""Whole runs as text: Markdown to paste, a LaTeX table as papers print it, and CSV with a row for each task.

One or two :class:`~vecenv_eval.report.run.Run` come in, and what :func:`~vecenv_eval.report.compare.compare` says about
them; text goes out.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import fields

from vecenv_eval.report.compare import Comparison
from vecenv_eval.report.findings import warnings
from vecenv_eval.report.run import Run, SuiteRun
from vecenv_eval.report.summary import Row
from vecenv_eval.report.tables import markdown as suite_markdown

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        **{character: "\\" + character for character in "&%$#_{}"},
    }
)
_AVERAGE = "average"


def markdown(runs: Sequence[Run], comparison: Comparison | None = None) -> str:
    """A table of suites, warnings, the comparison, and the tasks of each suite."""
    suites = _suites(runs)
    rows = [["run", *(_title(runs, suite) for suite in suites), _AVERAGE]]
    rows += [["---"] * len(rows[0])]
    for run in runs:
        by_name = {suite.suite: suite for suite in run.suites}
        rows.append([_label(run, runs), *(_cell(by_name.get(suite)) for suite in suites), _percent(run.average)])
    lines = [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in rows]
    parts = ["Success rates with Wilson 95 % intervals.", "\n".join(lines)]
    if comparison is not None:
        changed = [f"- {pair.episode.id}: solved -> failed" for pair in comparison.lost]
        changed += [f"- {pair.episode.id}: failed -> solved" for pair in comparison.won]
        parts += [comparison.sentence, *(["\n".join(changed)] if changed else [])]
    for run in runs:
        found = warnings(run)
        parts += [f"Warnings about {_label(run, runs)}:", "\n".join(f"- {text}" for text in found)] if found else []
        parts += [suite_markdown(suite.summary).strip() for suite in run.suites]
    return "\n\n".join(parts) + "\n"


def latex(runs: Sequence[Run]) -> str:
    """A ``tabular`` in booktabs' style, a row for each run and a column for each suite; and one of the tasks."""
    suites = _suites(runs)
    head = ["", *(_tex(_title(runs, suite)) for suite in suites), *(["Average"] if len(suites) > 1 else [])]
    body = []
    for run in runs:
        by_name = {suite.suite: suite for suite in run.suites}
        cells = [_tex_rate(by_name[suite].summary.total) if suite in by_name else "--" for suite in suites]
        average = [_tex_percent(run.average)] if len(suites) > 1 else []
        body.append([_tex(_label(run, runs)), *cells, *average])
    comment = "% Success rates in per cent with Wilson 95 % intervals; needs \\usepackage{booktabs}.\n"
    tables = [_tabular("l" + "r" * (len(head) - 1), head, body)]
    for run in runs:
        rows = [
            [_tex(suite.title), str(row.task), _tex(row.instruction), f"{row.successes}/{row.episodes}", _tex_rate(row)]
            for suite in run.suites
            for row in suite.summary.tasks
        ]
        tables.append(f"% {run.name}\n" + _tabular("lrlrr", ["Suite", "Task", "Instruction", "Solved", "Rate"], rows))
    return comment + "\n".join(tables)


def to_csv(runs: Sequence[Run]) -> str:
    """A row for each task and each suite (``task`` is ``all``), and each run's average over suites."""
    names = [each.name for each in fields(Row)]
    text = io.StringIO()
    writer = csv.DictWriter(text, ["run", "policy", "suite", *names], lineterminator="\n")
    writer.writeheader()
    for run in runs:
        for suite in run.suites:
            for row in (*suite.summary.tasks, suite.summary.total):
                values = {name: getattr(row, name) for name in names}
                writer.writerow({"run": run.name, "policy": suite.policy, "suite": suite.suite, **values})
        writer.writerow({"run": run.name, "policy": run.policy, "suite": _AVERAGE, "rate": run.average})
    return text.getvalue()


def _suites(runs: Sequence[Run]) -> list[str]:
    return list(dict.fromkeys(suite.suite for run in runs for suite in run.suites))


def _title(runs: Sequence[Run], name: str) -> str:
    return next(suite.title for run in runs for suite in run.suites if suite.suite == name)


def _label(run: Run, runs: Sequence[Run]) -> str:
    """What a row is called: the policy, with the folder where two runs have the same."""
    same = sum(other.policy == run.policy for other in runs) > 1
    return f"{run.policy} ({run.name})" if same else run.policy


def _cell(suite: SuiteRun | None) -> str:
    if suite is None or suite.summary.total.rate is None:
        return "-"
    total = suite.summary.total
    return f"{_percent(total.rate)} ({_percent(total.low)} to {_percent(total.high)})"


def _percent(rate: float | None) -> str:
    return "-" if rate is None else f"{rate:.1%}"


def _tex(text: str) -> str:
    return text.translate(_LATEX)


def _tex_percent(rate: float | None) -> str:
    return "--" if rate is None else f"{100 * rate:.1f}"


def _tex_rate(row: Row) -> str:
    if row.low is None or row.high is None:
        return "--"
    return f"{_tex_percent(row.rate)} {{\\scriptsize [{100 * row.low:.1f}, {100 * row.high:.1f}]}}"


def _tabular(columns: str, head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    rows = [" & ".join(row) + r" \\" for row in (head, *body)]
    return "\n".join(
        [
            f"\\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            rows[0],
            r"\midrule",
            *rows[1:],
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )
