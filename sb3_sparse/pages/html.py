"""Builds self-contained HTML pages: text, sortable tables, figures, style."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from sb3_sparse.pages.numbers import short
from sb3_sparse.pages.table import Cell, Table

READABLE = 0.9  # CSS pixels a point
STYLE = """
:root { color-scheme: light dark; --page: #fff; --line: #c8c8d0; --soft: #f3f3f7;
  --link: #362682; }
@media (prefers-color-scheme: dark) {
  :root { --page: #121216; --line: #4a4a55; --soft: #26262e; --link: #b3a6ff; }
}
* { box-sizing: border-box; }
body { background: var(--page); font: 16px/1.5 system-ui, sans-serif; margin: 0 auto;
  max-width: 84rem; padding: 1rem; }
p, li, figcaption { max-width: 60rem; }
h1 { font-size: 1.7rem; line-height: 1.2; } h2 { margin-top: 2.5rem; }
h1, h2, h3, p, li, code, figcaption, summary { overflow-wrap: anywhere; }
a { color: var(--link); }
.lead { font-size: 1.15rem; max-width: 48rem; }
nav ul { list-style: none; padding: 0; display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; }
.scroll { overflow-x: auto; border: 1px solid var(--line); border-radius: 6px; }
table { border-collapse: collapse; font-size: .85rem; width: 100%; }
th, td { padding: .3rem .6rem; text-align: left; border-bottom: 1px solid var(--line);
  vertical-align: top; }
th { background: var(--soft); white-space: nowrap; padding: 0; }
th button { all: unset; cursor: pointer; padding: .4rem .6rem; display: block; width: 100%;
  box-sizing: border-box; font-weight: 600; }
th.number button { text-align: right; }
th button:focus-visible { outline: 2px solid var(--link); outline-offset: -2px; }
th[aria-sort="ascending"] button::after { content: " \\25B2"; }
th[aria-sort="descending"] button::after { content: " \\25BC"; }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
th:first-child, td:first-child { position: sticky; left: 0; background: var(--page); }
th:first-child { background: var(--soft); }
td.wide { min-width: 10.5rem; }
td.good, td.bad, td.open { font-weight: 600; white-space: nowrap; }
td.good::before { content: "\\2713  "; } td.bad::before { content: "\\2717  "; }
td.open::before { content: "?  "; }
td.good { color: light-dark(#0a6b3d, #6fd6a2); }
td.bad { color: light-dark(#a8154f, #ff8ab8); }
figure { margin: 1rem 0 2rem; }
.row { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 28rem), 1fr));
  gap: 0 1rem; }
.row > * { min-width: 0; }
.row > :last-child:nth-child(odd) { grid-column: 1 / -1; }
.frame { background: #fff; border: 1px solid var(--line); border-radius: 6px;
  padding: .5rem; overflow-x: auto; }
figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figcaption { font-size: .9rem; margin-top: .4rem; }
pre { background: var(--soft); padding: .6rem; overflow-x: auto; border-radius: 6px; }
details { margin: .5rem 0; } summary { cursor: pointer; }
"""

SCRIPT = """
document.querySelectorAll("th button").forEach(function (button) {
  button.addEventListener("click", function () {
    var head = button.parentElement, table = head.closest("table"), body = table.tBodies[0];
    var column = head.cellIndex, up = head.getAttribute("aria-sort") !== "ascending";
    table.querySelectorAll("th").forEach(function (th) { th.setAttribute("aria-sort", "none"); });
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    function key(row) {
      var cell = row.cells[column], number = cell.dataset.value;
      return number === undefined ? cell.textContent : parseFloat(number);
    }
    Array.from(body.rows).sort(function (one, other) {
      var a = key(one), b = key(other);
      if (a === "" || b === "") return (a === "") - (b === "");
      var order = typeof a === "number" && typeof b === "number"
        ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true });
      return up ? order : -order;
    }).forEach(function (row) { body.appendChild(row); });
  });
});
"""


@dataclass(frozen=True)
class Section:
    """A part of a page with a heading, which the page's contents link to.

    :param heading: text, of which a page has no other section
    :param body: HTML
    """

    heading: str
    body: str

    @property
    def anchor(self) -> str:
        """The section's address within the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.heading.lower()).strip("-")

    def __str__(self) -> str:
        return (
            f'<section id="{self.anchor}"><h2>{escape(self.heading)}</h2>\n{self.body}\n</section>'
        )


def page(title: str, lead: Iterable[str], sections: Sequence[Section]) -> str:
    """Join HTML to a whole page, with a list of its sections below its lead.

    :param title: text
    :param lead: HTML above the contents
    :param sections: the rest of the page
    """
    parts = [*lead, _contents(sections), *map(str, sections)]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style></head>\n"
        f"<body>\n<h1>{escape(title)}</h1>\n"
        + "\n".join(parts)
        + f"\n<script>{SCRIPT}</script>\n</body></html>\n"
    )


def _contents(sections: Sequence[Section]) -> str:
    links = (f"<li>{link(f'#{one.anchor}', one.heading)}</li>" for one in sections)
    return f'<nav aria-label="contents"><ul>{"".join(links)}</ul></nav>'


def section(heading: str, *parts: str) -> Section:
    """Put parts under a heading."""
    return Section(heading, "\n".join(parts))


def lead(text: str) -> str:
    """Make the paragraph that says what the page found."""
    return f'<p class="lead">{escape(text)}</p>'


def subsection(heading: str, *parts: str) -> str:
    """Put parts under a heading within a section."""
    return "\n".join([f"<h3>{escape(heading)}</h3>", *parts])


def paragraph(text: str, *links: str) -> str:
    """Make a paragraph of a text, and of links behind it."""
    return f"<p>{' '.join([*([escape(text)] if text else []), *links])}</p>"


def listing(texts: Iterable[str]) -> str:
    """Make a list of texts."""
    return "<ul>" + "".join(f"<li>{escape(text)}</li>\n" for text in texts) + "</ul>"


def row(parts: Iterable[str]) -> str:
    """Put parts side by side, as many as the screen has room for."""
    return f'<div class="row">{"".join(parts)}</div>'


def folded(summary: str, *parts: str) -> str:
    """Hide parts until their summary is clicked."""
    return f"<details><summary>{escape(summary)}</summary>\n{''.join(parts)}</details>"


def code(text: str) -> str:
    """Make a block of code."""
    return f"<pre><code>{escape(text)}</code></pre>"


def link(address: str, text: str) -> str:
    """Make a link."""
    return f'<a href="{escape(address)}">{escape(text)}</a>'


def frame(picture: str) -> str:
    """Put a picture on white, where it scrolls if it is wide."""
    return f'<div class="frame">{picture}</div>'


def figure(
    name: str, title: str, picture: str, caption: str, links: Iterable[str], *parts: str
) -> str:
    """Frame a picture, with its title above and its caption below.

    :param name: address of the figure within the page
    :param picture: HTML, e.g. of :func:`image`
    :param links: HTML behind the caption
    :param parts: HTML below it
    """
    return (
        f'<figure id="{escape(name)}"><h3>{escape(title)}</h3>\n{frame(picture)}\n'
        f"<figcaption>{escape(caption)} {' '.join(links)}</figcaption>\n{''.join(parts)}</figure>"
    )


def image(svg: bytes, alt: str) -> str:
    """Embed a drawing; a wide one keeps a readable size.

    :param svg: the drawing
    :param alt: what it shows, as text
    """
    data = base64.b64encode(svg).decode()
    points = re.search(rb'<svg[^>]* width="([0-9.]+)pt"', svg)
    width = round(READABLE * float(points.group(1))) if points else 0
    style = f"min-width: {width}px"
    return f'<img alt="{escape(alt)}" style="{style}" src="data:image/svg+xml;base64,{data}">'


def table(given: Table) -> str:
    """Make a table that scrolls by itself, and sorts by a click or a key on a head."""
    heads = "".join(
        f'<th scope="col" aria-sort="none"{_side(place, given)}>'
        f'<button type="button">{escape(head)}</button></th>'
        for place, head in enumerate(given.heads)
    )
    rows = "".join(
        f"<tr>{''.join(_cell(value, given) for value in row)}</tr>\n" for row in given.rows
    )
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="table">'
        f"<table><thead><tr>{heads}</tr></thead>\n<tbody>{rows}</tbody></table></div>"
    )


def _side(column: int, table: Table) -> str:
    values = [row[column] for row in table.rows if row[column] is not None]
    return ' class="number"' if values and all(map(_is_number, values)) else ""


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, Cell)) and not isinstance(value, bool)


def _cell(value: Any, table: Table) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "<td></td>"
    if isinstance(value, Cell):
        text = f"<strong>{escape(value.text)}</strong>" if value.strong else escape(value.text)
        return f'<td class="number" data-value="{value.value!r}">{text}</td>'
    if _is_number(value):
        text = f"{value:,}" if isinstance(value, int) else short(value, table.digits)
        return f'<td class="number" data-value="{value!r}">{text}</td>'
    text = str(value)
    kind = table.marks.get(text) or ("wide" if len(text) > 40 else "")
    return f'<td class="{kind}">{escape(text)}</td>' if kind else f"<td>{escape(text)}</td>"
