"""Reports about evaluations: numbers, tables, and the page of ``vecenv report``."""

from vecenv_eval.report.summary import CONFIDENCE, TOTAL, Row, Summary, summarise, wilson
from vecenv_eval.report.tables import STAND_INS, closing_line, markdown, sanitized_line, stand_in_lines, table

__all__ = [
    "CONFIDENCE",
    "STAND_INS",
    "TOTAL",
    "Row",
    "Summary",
    "closing_line",
    "markdown",
    "sanitized_line",
    "stand_in_lines",
    "summarise",
    "table",
    "wilson",
]
