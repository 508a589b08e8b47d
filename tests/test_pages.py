"""Pages and tables, whatever they show."""

from __future__ import annotations

import re

import pytest

from sb3_sparse.pages import html
from sb3_sparse.pages.numbers import counted_between, short, shorten
from sb3_sparse.pages.table import Cell, Table

GIVEN = Table(
    ["name", "score", "verdict"],
    [["<a>", 1234.5678, "yes"], ["b", None, "no"], ["c", 12000, "perhaps"]],
    digits=3,
    marks={"yes": "good"},
)


def test_a_cell_shows_its_value_rounded_and_keeps_it_for_sorting():
    rows = re.findall(r"<tr><td>(.*?)</tr>", html.table(GIVEN))
    assert rows[0].startswith('&lt;a&gt;</td><td class="number" data-value="1234.5678">1,230<')
    assert rows[1].startswith("b</td><td></td>")
    assert rows[2].startswith('c</td><td class="number" data-value="12000">12,000<')


def test_marks_are_of_texts_and_heads_stand_above_their_numbers():
    text = html.table(GIVEN)
    assert text.count('<td class="good">yes</td>') == 1
    assert "<td>no</td>" in text
    heads = re.findall(r'<th scope="col" aria-sort="none"(.*?)>', text)
    assert heads == ["", ' class="number"', ""]


def test_a_cell_with_a_text_of_its_own_sorts_by_its_value():
    text = html.table(Table(["score"], [[Cell(370.2, "370")], [Cell(-8.0, "<8", strong=True)]]))
    assert '<th scope="col" aria-sort="none" class="number">' in text
    assert '<td class="number" data-value="370.2">370</td>' in text
    assert '<td class="number" data-value="-8.0"><strong>&lt;8</strong></td>' in text


@pytest.mark.parametrize(
    ("value", "two", "three"),
    [
        (0.0, "0", "0"),
        (-0.0, "0", "0"),
        (-154.03, "-150", "-154"),
        (5432.1, "5,400", "5,430"),
        (99.96, "100", "100"),
        (0.25, "0.25", "0.25"),
        (1e-6, "1e-6", "1e-6"),
        (0.00012345, "1.2e-4", "1.23e-4"),
        (0.0012345, "0.0012", "0.00123"),
        (1e6, "1,000,000", "1,000,000"),
        (-12345678.0, "-1.2e7", "-1.23e7"),
        (float("nan"), "nan", "nan"),
    ],
)
def test_a_number_is_short(value, two, three):
    assert (short(value), short(value, 3)) == (two, three)


def test_numbers_that_are_compared_get_a_third_digit_where_two_would_tie():
    assert shorten([-154.03, -76.1]) == ["-150", "-76"]
    assert shorten([-154.03, -151.2, -76.125]) == ["-154", "-151", "-76.1"]
    assert shorten([500.0, 500.0]) == ["500", "500"]  # they do tie
    assert shorten([500.01, 500.02]) == ["500", "500"]
    assert shorten([]) == []


def test_text_is_never_html():
    nasty = '<b>"&'
    parts = [html.paragraph(nasty), html.lead(nasty), html.subsection(nasty), html.code(nasty)]
    parts += [html.listing([nasty]), html.folded(nasty), html.link(nasty, nasty)]
    parts += [html.image(b"<svg/>", nasty), html.figure(nasty, nasty, "", nasty, [])]
    page = html.page(nasty, parts, [html.section(nasty)])
    assert "<b>" not in page
    assert page.count("&lt;b&gt;") == 16  # a heading stands in the contents, too


def test_the_contents_of_a_page_lead_to_its_sections():
    sections = [html.section("All cells, by task", "<p>one</p>"), html.section("Left out")]
    page = html.page("A study", [html.lead("SET won.")], sections)
    anchors = re.findall(r'<li><a href="#(.*?)">(.*?)</a></li>', page)
    assert anchors == [("all-cells-by-task", "All cells, by task"), ("left-out", "Left out")]
    assert [page.count(f'<section id="{anchor}">') for anchor, _ in anchors] == [1, 1]
    assert page.index("SET won.") < page.index("<nav") < page.index("<p>one</p>")


def test_columns_of_one_value_are_said_once():
    table = Table(
        ["task", "method", "seeds", "remark"], [["A", "set", 3, None], ["A", "rigl", 3, None]]
    )
    shorter, same = table.varying()
    assert (shorter.heads, shorter.rows) == (["method"], [["set"], ["rigl"]])
    assert same == {"task": "A", "seeds": 3}
    one = Table(["task", "seeds"], [["A", 3]])
    assert one.varying() == (one, {})


@pytest.mark.parametrize(
    ("counts", "text"), [([1], "1 seed"), ([5, 5], "5 seeds"), ([4, 1, 1200], "1 to 1,200 seeds")]
)
def test_counts_are_written_from_the_least_to_the_greatest(counts, text):
    assert counted_between(counts, "seed") == text
