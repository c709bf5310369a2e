"""Tables as data, and the same table as Markdown, LaTeX (booktabs) and CSV."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from mrtamp.bench.statistics import Interval, Summary


@dataclass(frozen=True)
class Share:
    """So many of so many."""

    part: int
    whole: int


Cell = str | int | Share | Summary | Interval | None
"""What stands in a table; None where there is nothing to say."""


@dataclass(frozen=True)
class Column:
    """A column: its title, what is better (`up`, `down` or nothing), and whether it is of text."""

    title: str
    better: str = ""
    text: bool = False


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes
    ----------
    label : short name, for cross references and files.
    groups : titles over neighbouring columns, with how many of them each spans; empty titles for none.
    rules : numbers of rows that have a rule above them.
    bars : whether vertical bars stand between groups (LaTeX).
    notes : what a reader has to know, below the table.
    """

    label: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    groups: tuple[tuple[str, int], ...] = ()
    rules: frozenset[int] = field(default_factory=frozenset)
    bars: bool = False
    notes: str = ""


# -- Markdown --------------------------------------------------------------------------------------------------------


def markdown(table: Table) -> str:
    """The table in Markdown; titles over several columns go into each of them."""
    over = _titles_over(table)
    arrows = {"up": " ↑", "down": " ↓", "": ""}
    titles = [
        (f"{group}: " if group else "") + column.title + arrows[column.better]
        for group, column in zip(over, table.columns, strict=True)
    ]
    sides = [":--" if column.text else "--:" for column in table.columns]
    lines = [titles, sides, *([_markdown_cell(cell) for cell in row] for row in table.rows)]
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return "\n\n".join(part for part in (f"**{table.caption}**", text, table.notes) if part)


def plain(table: Table) -> str:
    """The table for a terminal: columns of the same width throughout, blank lines where there are rules."""
    over = _titles_over(table)
    titles = [f"{group} {column.title}".strip() for group, column in zip(over, table.columns, strict=True)]
    lines = [titles, *([_markdown_cell(cell) for cell in row] for row in table.rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(titles))]
    out = []
    for number, line in enumerate(lines, -1):
        out += [""] if number in table.rules else []
        cells = [
            text.ljust(width) if column.text else text.rjust(width)
            for text, width, column in zip(line, widths, table.columns, strict=True)
        ]
        out.append("  ".join(cells).rstrip())
    return "\n".join([out[0], "-" * max(len(line) for line in out), *out[1:]])


def _markdown_cell(cell: Cell) -> str:
    if cell is None:
        return "-"
    if isinstance(cell, Share):
        return f"{cell.part}/{cell.whole}"
    if isinstance(cell, Summary):
        mean, deviation = number_texts(cell)
        return mean if deviation is None else f"{mean} ± {deviation}"
    if isinstance(cell, Interval):
        return f"{cell.value:.3g} [{cell.low:.3g}, {cell.high:.3g}]"
    return str(cell).replace("|", r"\|")


def _titles_over(table: Table) -> list[str]:
    if not table.groups:
        return [""] * len(table.columns)
    return [title for title, span in table.groups for _ in range(span)]


def number_texts(summary: Summary) -> tuple[str, str | None]:
    """Mean with three significant digits but no more than two decimals, the deviation with as many decimals."""
    size = abs(summary.mean)
    decimals = 0 if size >= 100 else 1 if size >= 10 else 2
    mean = f"{summary.mean:.{decimals}f}"
    return mean, None if summary.deviation is None else f"{summary.deviation:.{decimals}f}"


# -- LaTeX -----------------------------------------------------------------------------------------------------------

_SPECIAL = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "%": r"\%",
    "#": r"\#",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "*": r"$^\ast$",
    "<": r"$<$",
    ">": r"$>$",
    "±": r"$\pm$",
}
_SYMBOL = re.compile(r"([TJ])_(\w+)")
PREAMBLE = "% Needs \\usepackage{booktabs,multirow,graphicx}."


def escape(text: str) -> str:
    """Text for LaTeX; T_first and J_final become symbols."""
    out, end = [], 0
    for match in _SYMBOL.finditer(text):
        out += [_escaped(text[end : match.start()]), rf"${match[1]}_{{\mathrm{{{match[2]}}}}}$"]
        end = match.end()
    return "".join([*out, _escaped(text[end:])])


def _escaped(text: str) -> str:
    return "".join(_SPECIAL.get(character, character) for character in text)


def latex(table: Table) -> str:
    """The table as a floating environment over both columns, in the form of the paper's tables."""
    arrows = {"up": r" $\uparrow$", "down": r" $\downarrow$", "": ""}
    lines = [
        r"\begin{table*}[t]",
        r"\centering",
        rf"\caption{{{escape(' '.join(part for part in (table.caption, table.notes) if part))}}}",
        rf"\label{{tab:{table.label}}}",
        r"\resizebox{\textwidth}{!}{",
        rf"\begin{{tabular}}{{{_alignment(table)}}}",
        r"\toprule",
    ]
    titles = [escape(column.title) + arrows[column.better] for column in table.columns]
    if table.groups:
        over, rules, at = [], [], 0
        for title, span in table.groups:
            if title:
                bar = "|" if table.bars and at + span < len(titles) else ""
                over.append(rf"\multicolumn{{{span}}}{{c{bar}}}{{{escape(title)}}}")
                rules.append(rf"\cmidrule(lr){{{at + 1}-{at + span}}}")
            else:
                over += [rf"\multirow{{2}}{{*}}{{{titles[at + i]}}}" for i in range(span)]
                titles[at : at + span] = [""] * span
            at += span
        lines += [" & ".join(over) + r" \\", "".join(rules)]
    lines += [" & ".join(titles).strip() + r" \\", r"\midrule"]
    for i, row in enumerate(table.rows):
        lines += [r"\midrule"] if i in table.rules else []
        lines.append(" & ".join(_latex_cell(cell) for cell in row) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}", "}", r"\end{table*}"]
    return "\n".join(lines) + "\n"


def _alignment(table: Table) -> str:
    letters = ["l" if column.text else "c" for column in table.columns]
    if not table.bars:
        return "".join(letters)
    waiting = iter(letters)
    return "|".join("".join(next(waiting) for _ in range(span)) for _, span in table.groups)


def _latex_cell(cell: Cell) -> str:
    if cell is None:
        return "--"
    if isinstance(cell, Share):
        return rf"{100 * cell.part / cell.whole:.0f}\%"
    if isinstance(cell, Summary):
        mean, deviation = number_texts(cell)
        return f"${mean}$" if deviation is None else rf"${mean}\pm {deviation}$"
    if isinstance(cell, Interval):
        high = r"\infty" if cell.high == float("inf") else f"{cell.high:.3g}"
        return rf"${cell.value:.3g}$ $[{cell.low:.3g}, {high}]$"
    return escape(str(cell))


# -- CSV -------------------------------------------------------------------------------------------------------------


def comma_separated(lines: Sequence[Sequence[object]]) -> str:
    """Lines of values as CSV."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(lines)
    return stream.getvalue()


def table_csv(table: Table) -> str:
    """The table as CSV: means and deviations in columns of their own, success as a share from 0 to 1."""
    spread = [i for i in range(len(table.columns)) if any(isinstance(row[i], Summary) for row in table.rows)]
    bounded = [i for i in range(len(table.columns)) if any(isinstance(row[i], Interval) for row in table.rows)]
    titles: list[object] = []
    for i, (over, column) in enumerate(zip(_titles_over(table), table.columns, strict=True)):
        name = f"{over} {column.title}".strip()
        titles += [name]
        titles += [f"{name} deviation"] if i in spread else []
        titles += [f"{name} low", f"{name} high"] if i in bounded else []
    lines = [titles]
    for row in table.rows:
        line: list[object] = []
        for i, cell in enumerate(row):
            if i in spread:
                line += [cell.mean, cell.deviation] if isinstance(cell, Summary) else [None, None]
            elif i in bounded:
                line += [cell.value, cell.low, cell.high] if isinstance(cell, Interval) else [None] * 3
            else:
                line.append(cell.part / cell.whole if isinstance(cell, Share) else cell)
        lines.append(line)
    return comma_separated(lines)
