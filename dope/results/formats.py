"""A results table as text for the terminal, as Markdown or as LaTeX (booktabs)."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence

from rich.cells import cell_len

from dope.results.table import Cell, ResultsTable, TableLine

SUFFIXES = {".md": "markdown", ".tex": "latex"}
"""Formats told by the suffix of `--out`; others are text."""
WIDTH = 100  # of the caption in text


def write_table(table: ResultsTable, form: str) -> str:
    """The table as "text", "markdown" or "latex", ending with a line break."""
    return {"text": as_text, "markdown": as_markdown, "latex": as_latex}[form](table)


def as_text(table: ResultsTable) -> str:
    """Columns aligned by spaces, for a terminal of any width and for files."""
    header = _header(table)
    lines: list[Sequence[str] | str] = [header]
    for block in table.blocks:
        lines += [block.title] if block.title else []
        lines += [_fields(line, table, _plain) for line in block.lines]
    rows = [line for line in lines if not isinstance(line, str)]
    widths = [max(cell_len(row[i]) for row in rows) for i in range(len(header))]
    left = _left_columns(table)

    def aligned(row: Sequence[str]) -> str:
        room = [" " * (width - cell_len(field)) for width, field in zip(widths, row, strict=True)]
        fields = [f + r if i < left else r + f for i, (f, r) in enumerate(zip(row, room, strict=True))]
        return "  ".join(fields).rstrip()

    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    drawn = [table.title, rule, aligned(header), rule]
    for line in lines[1:]:
        drawn += [rule, line] if isinstance(line, str) else [aligned(line)]
    return "\n".join([*drawn, rule, *textwrap.wrap(_caption(table, "*"), max(WIDTH, len(rule)))]) + "\n"


def as_markdown(table: ResultsTable) -> str:
    """A pipe table, its caption below."""
    header = _header(table)
    left = _left_columns(table)
    drawn = [f"**{_md(table.title)}**", "", _pipes(header)]
    drawn.append(_pipes([":--" if i < left else "--:" for i in range(len(header))]))
    for block in table.blocks:
        if block.title:
            drawn.append(_pipes([f"*{_md(block.title)}*", *[""] * (len(header) - 1)]))
        drawn += [_pipes(_fields(line, table, _markdown_cell, _md)) for line in block.lines]
    return "\n".join([*drawn, "", _md(_caption(table, "Bold"))]) + "\n"


def as_latex(table: ResultsTable) -> str:
    r"""A table environment; needs \usepackage{booktabs}."""
    header = _header(table)
    left = _left_columns(table)
    drawn = [
        r"\begin{table}",
        r"  \centering\footnotesize\setlength{\tabcolsep}{4pt}",
        rf"  \caption{{{_tex(table.title)}. {_tex(_caption(table, 'Bold'))}}}",
        rf"  \begin{{tabular}}{{{'l' * left}{'r' * (len(header) - left)}}}",
        r"    \toprule",
        "    " + " & ".join(map(_tex, header)) + r" \\",
    ]
    for block in table.blocks:
        drawn.append(r"    \midrule")
        if block.title:
            drawn.append(rf"    \multicolumn{{{len(header)}}}{{l}}{{\emph{{{_tex(block.title)}}}}} \\")
        drawn += ["    " + " & ".join(_fields(line, table, _latex_cell, _tex)) + r" \\" for line in block.lines]
    return "\n".join([*drawn, r"    \bottomrule", r"  \end{tabular}", r"\end{table}"]) + "\n"


def _header(table: ResultsTable) -> list[str]:
    return ["method", *(["classifier"] if table.with_classifier else []), *table.columns]


def _left_columns(table: ResultsTable) -> int:
    return 2 if table.with_classifier else 1


def _fields(
    line: TableLine,
    table: ResultsTable,
    cell: Callable[[Cell, int], str],
    escape: Callable[[str], str] = str,
) -> list[str]:
    texts = [escape(line.label), *([escape(line.classifier)] if table.with_classifier else [])]
    return texts + ["" if value is None else cell(value, table.n_splits) for value in line.cells]


def _caption(table: ResultsTable, best: str) -> str:
    return " ".join(table.caption).replace("{best}", best)


def _plain(cell: Cell, n_splits: int) -> str:
    mark = "*" if cell.best else ""
    return f"{cell.accuracy:.2f}{mark}{_interval(cell)}{_of_splits(cell, n_splits)}"


def _markdown_cell(cell: Cell, n_splits: int) -> str:
    number = f"{cell.accuracy:.2f}{_interval(cell)}"
    return (f"**{number}**" if cell.best else number) + _of_splits(cell, n_splits)


def _latex_cell(cell: Cell, n_splits: int) -> str:
    number = rf"\mathbf{{{cell.accuracy:.2f}}}" if cell.best else f"{cell.accuracy:.2f}"
    interval = "" if cell.ci95 is None else rf" \pm {cell.ci95:.2f}"
    return f"${number}{interval}${_of_splits(cell, n_splits)}"


def _interval(cell: Cell) -> str:
    return "" if cell.ci95 is None else f" ± {cell.ci95:.2f}"


def _of_splits(cell: Cell, n_splits: int) -> str:
    return f" ({len(cell.splits)}/{n_splits})" if cell.missing else ""


def _pipes(fields: Sequence[str]) -> str:
    return "| " + " | ".join(fields) + " |"


def _md(text: str) -> str:
    for character in "\\`*_|<>[]":
        text = text.replace(character, "\\" + character)
    return " ".join(text.split())


def _tex(text: str) -> str:
    special = {
        "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
        "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
        "±": r"$\pm$",
    }  # fmt: skip
    return "".join(special.get(character, character) for character in " ".join(text.split()))
