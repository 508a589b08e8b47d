"""The documents show what docs/draw.py gives of the archive of runs."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(
    not (ROOT / "docs/results/runs.jsonl").is_file(),
    reason="a source distribution has no archive of runs",
)


@pytest.fixture(scope="module")
def draw():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "docs")
        return importlib.import_module("draw")


@pytest.fixture(scope="module")
def texts(draw):
    return {path.name: path.read_text() for path in draw.DOCUMENTS}


@pytest.fixture(scope="module")
def drawn(draw, texts):
    (count,) = draw.LINES.findall(texts["findings.md"])
    return draw.Drawn(draw.ARCHIVE, int(count.replace(",", "")))


def blocks(draw, texts):
    return {
        found[2]: found[0].split("\n", 1)[1].rsplit("<!-- end -->", 1)[0]
        for text in texts.values()
        for found in draw.BLOCK.finditer(text)
    }


@pytest.mark.parametrize("name", ["finding snr", "scores ppo small parameters"])
def test_a_block_is_what_its_lines_of_the_archive_give(draw, drawn, texts, name):
    assert blocks(draw, texts)[name] == drawn.block(name)


def test_every_finding_of_the_paper_has_its_block(draw, texts):
    found = [name.split()[1] for name in blocks(draw, texts) if name.startswith("finding ")]
    assert found == [finding.key for finding in draw.FINDINGS]
    studies = [draw.Study.read(*where) for where in draw.STUDIES]
    assert {key for study in studies for key in study.findings} == set(found)


def test_every_picture_is_there_and_none_is_left_over(draw, texts):
    shown = set(re.findall(r"figures/([\w.-]+\.svg)", "".join(texts.values())))
    assert shown == {path.name for path in (ROOT / "docs/figures").iterdir()}


def test_only_the_first_lines_of_an_archive_count(draw, tmp_path):
    lines = draw.ARCHIVE.read_text().splitlines(keepends=True)
    wanted = [line for line in lines if json.loads(line)["record"]["run"]["algo"] == "ppo"]
    archive = tmp_path / "runs.jsonl"
    archive.write_text("".join(wanted[:3]))
    two = draw.Drawn(archive, 2)
    assert two.block("archive") == "Drawn from the first 2 lines of the archive.\n"
    assert len(two.shown("ppo", "small").results.runs) == 2
    assert len(draw.Drawn(archive).shown("ppo", "small").results.runs) == 3
