"""Pages and tables, whatever they show."""

from __future__ import annotations

import re

from sb3_sparse.pages import html
from sb3_sparse.pages.table import Table

GIVEN = Table(
    ["name", "score", "verdict"],
    [["<a>", 1234.5678, "yes"], ["b", None, "no"], ["c", 12000, "perhaps"]],
    digits=3,
    marks={"yes": "good"},
)


def test_a_cell_shows_its_value_rounded_and_keeps_it_for_sorting():
    rows = re.findall(r"<tr><td>(.*?)</tr>", html.table(GIVEN))
    assert rows[0].startswith('&lt;a&gt;</td><td class="number" data-value="1234.5678">1.23e+03<')
    assert rows[1].startswith("b</td><td></td>")
    assert rows[2].startswith('c</td><td class="number" data-value="12000">12,000<')


def test_marks_are_of_texts_and_heads_stand_above_their_numbers():
    text = html.table(GIVEN)
    assert text.count('<td class="good">yes</td>') == 1
    assert "<td>no</td>" in text
    heads = re.findall(r'<th scope="col" aria-sort="none"(.*?)>', text)
    assert heads == ["", ' class="number"', ""]


def test_text_is_never_html():
    nasty = '<b>"&'
    parts = [html.paragraph(nasty), html.section(nasty), html.subsection(nasty), html.code(nasty)]
    parts += [html.listing([nasty]), html.folded(nasty), html.link(nasty, nasty)]
    parts += [html.image(b"<svg/>", nasty), html.figure(nasty, nasty, "", nasty, [])]
    page = html.page(nasty, parts)
    assert "<b>" not in page
    assert page.count("&lt;b&gt;") == 14
