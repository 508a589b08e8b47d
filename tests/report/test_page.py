from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess

import pytest

from sb3_sparse.errors import ConfigError
from sb3_sparse.report import FIGURES, write_report
from sb3_sparse.report.figures.base import FIGURES as TABLE

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
NASTY = '<script>alert(1)</script> & "more"'
ASK = """
<script>
var errors = 0; window.onerror = function () { errors++; };
window.addEventListener("load", function () {
  var table = Array.from(document.querySelectorAll("table")).find(function (t) {
    return t.textContent.includes("mean score"); }), heads = table.querySelectorAll("th");
  var column = Array.from(heads).findIndex(function (h) {
    return h.textContent === "mean score"; });
  function values() { return Array.from(table.tBodies[0].rows).map(function (row) {
    return parseFloat(row.cells[column].dataset.value); }).filter(function (v) {
    return !isNaN(v); }); }
  heads[column].firstChild.click();
  var up = values(), first = heads[column].getAttribute("aria-sort");
  heads[column].firstChild.click();
  var down = values(), second = heads[column].getAttribute("aria-sort");
  var out = document.createElement("pre"); out.id = "told";
  out.textContent = JSON.stringify({
    shown: Array.from(document.images).filter(function (i) { return i.naturalWidth > 0; }).length,
    images: document.images.length, up: up, down: down, sorts: [first, second], errors: errors,
    wide: document.documentElement.scrollWidth, window: window.innerWidth });
  document.body.appendChild(out);
});
</script>
"""


@pytest.fixture(scope="module")
def report(study_folders, tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    return write_report(
        [*study_folders, out / "nowhere"], out, title=NASTY, figures=list(FIGURES),
        varies="weight_decay", command=f"continue {NASTY}", pending=[f"cell {NASTY}"],
    )  # fmt: skip


def test_the_page_says_which_tasks_have_no_scale_and_how_to_give_one(folders, tmp_path):
    for seed in range(3):
        folders.add("rigl", 0.9, seed, -300.0, env_id="Maze-v0")
        folders.add("dense", None, seed, -200.0, env_id="Maze-v0")
    page, given = (
        write_report(folders.made, tmp_path / name, title="Maze", figures=["curves"], **more)
        for name, more in (("a", {}), ("b", {"references": {"Maze-v0": (-500.0, -100.0)}}))
    )
    assert re.search(
        "Tasks without a scale .*reference_returns in a study.*score is -200, by",
        page.read_text(),
        re.DOTALL,
    )
    assert "These runs have no data, or none on a scale, on:" in page.read_text()
    text = given.read_text()
    assert "Tasks without a scale" not in text
    assert (
        "Maze-v0: 0 stands for a score of -500, 1 for -100 (reference_returns of the study)" in text
    )
    assert "contradicted" in text


@pytest.mark.parametrize("name", list(TABLE))
def test_each_figure_is_drawn_and_has_its_numbers(report, name):
    folder = report.parent / "figures"
    assert (folder / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    assert "<svg" in (folder / f"{name}.svg").read_text()[:600]
    rows = list(csv.reader((folder / f"{name}.csv").open()))
    assert len(rows) > 1
    assert {len(row) for row in rows} == {len(rows[0])}


def test_the_numbers_behind_figures_are_right(report):
    rows = list(csv.DictReader((report.parent / "figures" / "flops.csv").open()))
    share = {
        row["sparsity"]: float(row["share"]) for row in rows if "Acrobot" in row["environment"]
    }
    assert share == pytest.approx({"0.8": 0.2, "0.95": 0.05}, abs=1e-3)
    rows = list(csv.DictReader((report.parent / "figures" / "ratio.csv").open()))
    scores = {float(row["actor's share"]): float(row["mean score"]) for row in rows}
    assert scores == {0.1: 1000.0, 0.34: 1000.0, 0.9: 500.0}
    rows = list(csv.DictReader((report.parent / "figures" / "sensitivity.csv").open()))
    found = {
        row["value"]: float(row["mean score"])
        for row in rows
        if (row["environment"], row["method"], row["sparsity"]) == ("CartPole-v1", "rigl", "0.8")
    }
    assert {"1e-06", "0.001"} <= set(found)
    assert (found["1e-06"], found["0.001"]) == (410.0, 400.0)
    rows = list(csv.DictReader((report.parent / "figures" / "seconds.csv").open()))
    found = {
        (row["method"], row["net_arch"]): (float(row["seconds of training"]), row["mean score"])
        for row in rows
    }
    assert found == {
        ("dense", "[256]"): (256.0, "266"),
        ("dense", "[512]"): (512.0, "522"),
        ("dense-equal", "[256]"): (256.0, "266"),
        ("dense-equal", "[512]"): (512.0, "522"),
        ("rigl", "[256]"): (128.0, "266"),
        ("rigl", "[512]"): (256.0, "522"),
    }
    rows = list(csv.DictReader((report.parent / "figures" / "scaling.csv").open()))
    sizes = {
        (row["method"], row["net_arch"]): int(row["parameters"])
        for row in rows
        if row["environment"] == "HalfCheetah-v5"
    }
    full, half = 64 * 64 + 10, 32 * 64 + 10
    assert (sizes["dense", "[512]"], sizes["dense", "[256]"]) == (full, half)
    assert sizes["rigl", "[512]"] == sizes["dense-equal", "[512]"] == round(409.6) + 10
    rows = list(csv.DictReader((report.parent / "figures" / "snr.csv").open()))
    assert {row["network"] for row in rows} == {"q_net"}


def test_the_page_says_all_that_it_must(report):
    text = report.read_text()
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; &quot;more&quot;" in text
    for wanted in ("no such folder", "still to be trained", "Mnih et al. 2015",
                   "torch 2.13.0", "name=\"viewport\"", "1 only counted"):  # fmt: skip
        assert wanted in text
    assert not re.search(r"""(src|href)=["'](https?:)?//""", text)
    for name in ("cells.csv", "runs.csv", "verdicts.csv"):
        assert len((report.parent / name).read_text().splitlines()) > 5


def test_the_same_runs_give_the_same_bytes(study_folders, tmp_path):
    few = study_folders[:6]
    pages = [
        write_report(few, tmp_path / name, title="t", figures=["parameters", "iqm"])
        for name in ("a", "b")
    ]
    for path in sorted(pages[0].parent.rglob("*.*")):
        other = pages[1].parent / path.relative_to(pages[0].parent)
        assert path.read_bytes() == other.read_bytes(), path.name


def test_a_figure_without_data_is_left_out_with_a_reason(folders, tmp_path):
    folders.add()
    page = write_report(folders.made, tmp_path, title="t", figures=["noise", "iqm"]).read_text()
    assert "Left out: no run has a robustness.csv" in page
    assert "fewer than 2 runs" in page


@pytest.mark.parametrize(("name", "lost"), [("noise", "robustness.csv"), ("masks", "*.zip")])
def test_what_cannot_be_drawn_again_stays_and_the_page_says_so(name, lost, folders, tmp_path):
    """As in a clone of a repository that has the reports, and not the models."""
    folders.add(noise={0.0: 1.0, 1.0: 1.0}, model=True)
    out = tmp_path / "out"
    write_report(folders.made, out, title="t", figures=[name])
    before = {path: path.read_bytes() for path in (out / "figures").iterdir()}
    assert {path.name for path in before} == {f"{name}.{kind}" for kind in ("png", "svg", "csv")}
    (gone,) = folders.made[0].glob(lost)
    gone.unlink()
    page = write_report(folders.made, out, title="t", figures=[name]).read_text()
    assert {path: path.read_bytes() for path in (out / "figures").iterdir()} == before
    assert "the figure of an earlier report. It cannot be drawn now: no " in page
    assert f"figures/{name}.svg" in page


def test_a_study_of_one_finding_opens_with_its_verdict(folders, tmp_path):
    for seed in range(3):
        folders.add("rigl", 0.9, seed, 400.0 + seed, snr={"snr/q_net": 0.1})
        folders.add("dense", None, seed, 300.0 + seed, snr={"snr/q_net": 0.2})
    one = write_report(folders.made, tmp_path / "1", title="T", figures=["snr"], findings=["snr"])
    leads = re.findall(r'<p class="lead">(.*?)</p>', one.read_text())
    assert leads[0] == (
        "The gradients&#x27; signal-to-noise ratio falls with sparsity: supported, "
        "-0.69 [-0.69; -0.69] of the log SNR; 3 seeds."
    )
    assert leads[1:] == [
        "CartPole-v1, geometric mean of the ratio over training: dense 0.2; 90 % 0.1; 3 seeds."
    ]
    both = write_report(
        folders.made, tmp_path / "2", title="T", figures=["snr"], findings=["snr", "no-loss"]
    )
    (score,) = re.findall(r'<p class="lead">(.*?)</p>', both.read_text())
    assert score.startswith("CartPole-v1 at 90 %: RigL ")


def test_runs_that_diverged_have_a_section_of_their_own(folders, tmp_path):
    for seed, status in enumerate(["finished", "diverged", "running"]):
        folders.add("rigl", 0.9, seed, status=status)
    page = write_report(folders.made, tmp_path / "out", title="T", figures=["iqm"]).read_text()
    assert "1 finished run, 1,000 environment steps; 1 diverged; 1 left out." in page
    diverged = page.split("<h2>Diverged<")[1].split("</section>")[0]
    assert "DQN on CartPole-v1, rigl 90%, seed 1: training diverged" in diverged
    assert "seed 2" not in diverged


def test_a_report_on_nothing_is_a_page_all_the_same(tmp_path):
    page = write_report([], tmp_path / "out", title="t", figures=list(FIGURES)).read_text()
    assert page.count("Left out: ") == len(FIGURES)


def test_the_page_names_the_commits_of_its_runs(folders, tmp_path):
    """Records of older versions have none."""
    for seed, commit in enumerate(["0123456789ab", "ba9876543210 changed", None]):
        record = folders.add(seed=seed) / "sparsity.json"
        content = json.loads(record.read_text())
        content["versions"].update({} if commit is None else {"commit": commit})
        record.write_text(json.dumps(content))
    page = write_report(folders.made, tmp_path / "out", title="T", figures=["iqm"]).read_text()
    assert "commit 0123456789ab and ba9876543210 changed" in page


def test_an_unknown_figure_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ConfigError, match="unknown figure 'pie'; allowed are .*iqm"):
        write_report([], tmp_path / "out", title="t", figures=["pie"])
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(BROWSER is None, reason="needs chromium or google-chrome")
@pytest.mark.parametrize("width", [1280, 390])
def test_the_page_works_in_a_browser(report, tmp_path, width):
    page = tmp_path / "page.html"
    page.write_text(report.read_text().replace("<head>", "<head>" + ASK, 1))
    frame = tmp_path / "frame.html"  # a window is never narrower than 500 pixels; a frame is
    frame.write_text(
        f'<iframe id="it" src="page.html" style="width:{width}px;height:900px;border:0"></iframe>'
        '<script>document.getElementById("it").onload = function () { setTimeout(function () {'
        "document.body.appendChild(document.importNode("
        'document.getElementById("it").contentDocument.getElementById("told"), true)); }, 500); };'
        "</script>"
    )
    command = [
        BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
        "--allow-file-access-from-files", f"--user-data-dir={tmp_path / 'profile'}",
        "--virtual-time-budget=10000", "--dump-dom", frame.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    found = re.search(r'<pre id="told">(.*?)</pre>', done.stdout)
    assert found, done.stderr[-2000:]
    told = json.loads(found.group(1))
    assert told["shown"] == told["images"] == len(FIGURES)
    assert told["up"] == sorted(told["up"])
    assert told["down"] == told["up"][::-1]
    assert told["sorts"] == ["ascending", "descending"]
    assert told["errors"] == 0
    assert told["window"] == width
    assert told["wide"] <= width


def test_dense_networks_of_other_budgets_are_never_averaged(folders, tmp_path):
    """Two budgets, each with an actor of a tenth and of a third of the connections."""
    for seed in range(3):
        for total, score in ((1.0, 1000.0), (0.2, 300.0)):
            for share in (0.1, 0.34):
                arch = {"pi": [int(100 * share)], "qf": [int(1000 * total)]}
                folders.add(
                    "dense", None, seed, score + 100 * share, env_id="Hopper-v5", algo="sac",
                    share=share, size=total, policy={"net_arch": arch},
                    overrides={"net_arch": arch},
                )  # fmt: skip
    write_report(folders.made, tmp_path / "out", title="T", figures=["ratio"])
    rows = list(csv.DictReader((tmp_path / "out/figures/ratio.csv").open()))
    found = {
        (float(row["budget"]), float(row["actor's share"])): float(row["mean score"])
        for row in rows
    }
    assert found == {(1.0, 0.1): 1010.0, (1.0, 0.34): 1034.0, (0.2, 0.1): 310.0, (0.2, 0.34): 334.0}
    cells = list(csv.DictReader((tmp_path / "out/cells.csv").open()))
    assert [row["seeds"] for row in cells] == ["3"] * 4
