"""Pieces of HTML."""

import html
from collections.abc import Iterable, Sequence

escape = html.escape


def number(value: int) -> str:
    """An integer with separators."""
    return f"{value:,}"


def tiles(pairs: Iterable[tuple[str, str]]) -> str:
    """Large values with labels."""
    inner = "".join(f"<li><b>{escape(value)}</b><span>{escape(what)}</span></li>" for value, what in pairs)
    return f'<ul class="tiles">{inner}</ul>'


def figure(svg: str, caption: str) -> str:
    """A chart with its explanation."""
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{svg}{below}</figure>"


def table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    groups: Sequence[tuple[str, int]] = (),
    caption: str = "",
    text: Sequence[int] = (),
    total: bool = False,
) -> str:
    """A table.

    Args:
        columns: Their heads.
        rows: Cells as texts; one that begins with ``!`` is marked as bad.
        groups: Heads above the columns, each with how many it spans.
        caption: What it shows.
        text: Columns of words besides the first.
        total: Whether the last row sums up.
    """
    above = "".join(f'<th colspan="{span}">{escape(name)}</th>' for name, span in groups)
    head = f"<tr>{above}</tr>" if groups else ""
    head += "<tr>" + "".join(f"<th{_kind(i, text)}>{escape(name)}</th>" for i, name in enumerate(columns)) + "</tr>"
    body = "".join("<tr>" + "".join(_cell(i, cell, text) for i, cell in enumerate(row)) + "</tr>" for row in rows)
    title = f'<p class="dim">{escape(caption)}</p>' if caption else ""
    plain = "" if total else ' class="plain"'
    return f'{title}<div class="wide"><table><thead>{head}</thead><tbody{plain}>{body}</tbody></table></div>'


def _kind(column: int, text: Sequence[int]) -> str:
    return ' class="text"' if column in text else ""


def _cell(column: int, cell: str, text: Sequence[int]) -> str:
    if cell.startswith("!"):
        return f'<td class="bad">{escape(cell[1:])}</td>'
    kind = ' class="text wrap"' if column in text and len(cell) > 60 else _kind(column, text)
    return f"<td{kind}>{escape(cell)}</td>"
