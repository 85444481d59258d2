"""Tables that can be read at any width: every command prints its tables through :class:`FittedTable`.

Columns and rows of texts come in; something that rich prints goes out. What happens when the screen is too narrow is
decided here and nowhere else: free text wraps between words; then columns move closer together; then the table is split
into several, each with the key columns; and where not even one column fits beside the keys, every row becomes a list
of ``name: value`` lines. No cell is ever truncated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.table import Table
from rich.text import Text

# Free text is not wrapped to less than this, and words longer than the second are folded. In screen columns.
_NARROWEST, _LONGEST_WORD = 16, 40
# Spaces between columns: two, or one where that makes the table fit.
_GAPS = (2, 1)


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: its heading, which wraps between words.
        text: its cells are free text, which may wrap; others stay on one line.
        key: it says what a row is about, and is repeated where the table is split.
        justify: ``"left"`` or ``"right"``.
    """

    name: str
    text: bool = False
    key: bool = False
    justify: Literal["left", "right"] = "left"


@dataclass(frozen=True, kw_only=True)
class FittedTable:
    """A table that fits the console it is printed on.

    Attributes:
        columns: the columns.
        rows: the cells of each row, as many as columns; no markup is read in them.
        title, caption: lines above and below, "" for none.
        styles: rich's style of some rows, by index.
        total: the last row sums up the others: it is bold, below a line.
    """

    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    title: str = ""
    caption: str = ""
    styles: Mapping[int, str] = field(default_factory=dict)
    total: bool = False

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        """Yield the table, or the tables it is split into, for the width of the console."""
        if self.title:
            yield Text(self.title, style="table.title")
        yield self._fitted(options.max_width)
        if self.caption:
            yield Text(self.caption, style="table.caption")

    def _fitted(self, width: int) -> RenderableType:
        everything = list(range(len(self.columns)))
        for gap in _GAPS:
            if self._least(everything, gap) <= width:
                return self._table(everything, gap, width)
        parts = self._split(width)
        if parts is None:
            return Group(*self._records())
        blank = [Text("")]
        tables: list[RenderableType] = []
        for part in parts:
            tables += [*(blank if tables else []), self._table(part, _GAPS[0], width)]
        return Group(*tables)

    def _split(self, width: int) -> list[list[int]] | None:
        """Columns of each part, the keys first; None when some column does not fit beside the keys."""
        keys = [index for index, column in enumerate(self.columns) if column.key]
        parts = [keys]
        for index in (index for index, column in enumerate(self.columns) if not column.key):
            if self._least([*keys, index], _GAPS[0]) > width:
                return None
            if self._least([*parts[-1], index], _GAPS[0]) > width:
                parts.append(keys)
            parts[-1] = [*parts[-1], index]
        return parts

    def _table(self, chosen: Sequence[int], gap: int, width: int) -> Table:
        widths = self._widths(chosen, width - gap * (len(chosen) - 1))
        table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, gap - 1, 0, 0))
        for index, room in zip(chosen, widths, strict=True):
            column = self.columns[index]
            table.add_column(Text(column.name), justify=column.justify, width=room, overflow="fold")
        for number, row in enumerate(self.rows):
            last = self.total and number == len(self.rows) - 1
            if last:
                table.add_section()
            style = self.styles.get(number) or ("bold" if last else None)
            table.add_row(*(Text(row[index], overflow="fold") for index in chosen), style=style)
        return table

    def _records(self) -> Iterator[Text]:
        for number, row in enumerate(self.rows):
            if number:
                yield Text("")
            for column, cell in zip(self.columns, row, strict=True):
                yield Text(f"{column.name}: {cell}", style=self.styles.get(number, ""), overflow="fold")

    def _widths(self, chosen: Sequence[int], room: int) -> list[int]:
        """Widths of columns that together fit ``room``; the widest gives way first."""
        widths = [self._natural(index) for index in chosen]
        least = [self._narrowest(index) for index in chosen]
        while sum(widths) > room:
            loose = [i for i in range(len(widths)) if widths[i] > least[i]]
            widths[max(loose, key=lambda i: widths[i])] -= 1
        return widths

    def _least(self, chosen: Sequence[int], gap: int) -> int:
        return sum(map(self._narrowest, chosen)) + gap * (len(chosen) - 1)

    def _natural(self, index: int) -> int:
        return max(_width(self.columns[index].name), *map(_width, self._cells(index)), 1)

    def _narrowest(self, index: int) -> int:
        column, natural = self.columns[index], self._natural(index)
        words = column.name.split()
        if not column.text:
            return max(*map(cell_len, words), *map(_width, self._cells(index)), 1, 1)
        words += [word for cell in self._cells(index) for word in cell.split()]
        return max(min(natural, _NARROWEST), min(_LONGEST_WORD, max(map(cell_len, words), default=0)))

    def _cells(self, index: int) -> list[str]:
        return [row[index] for row in self.rows]


def _width(text: str) -> int:
    return max(map(cell_len, text.splitlines()), default=0)


def from_rows(rows: Sequence[Mapping[str, object]], *, keys: int = 1, title: str = "") -> FittedTable:
    """A table of mappings with the same names: the first ``keys`` columns are the keys, texts with spaces may wrap.

    Args:
        rows: at least one; floats are printed with two decimals.
        keys: how many columns say what a row is about.
        title: line above the table.
    """
    cells = [[f"{value:.2f}" if isinstance(value, float) else str(value) for value in row.values()] for row in rows]
    columns = [
        Column(
            name,
            text=isinstance(rows[0][name], str) and any(" " in row[index] for row in cells),
            key=index < keys,
            justify="left" if isinstance(rows[0][name], str) else "right",
        )
        for index, name in enumerate(rows[0])
    ]
    return FittedTable(columns=columns, rows=cells, title=title)
