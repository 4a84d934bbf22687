"""Output of a batch: lines, events, and the table."""

import csv
import json
import re
import shutil

import pytest

from pimper_torch.cli.batches.table import write_table
from pimper_torch.cli.batches.task import Outcome
from pimper_torch.cli.main import main


@pytest.mark.parametrize("failing", [True, False])
def test_each_object_has_a_line_and_failures_set_the_exit_code(world, capsys, failing):
    world.add("ball")
    world.add("cup", "fail('InputError', 2)" if failing else "end()")
    code = main(["batch", str(world.folder / "scans"), "-o", str(world.out), "--jobs", "1"])
    printed = capsys.readouterr()
    assert code == (2 if failing else 0)
    ball, cup, totals = printed.out.splitlines()
    assert ball.split()[:2] == ["ball", "ended"]
    assert cup.split()[:2] == ["cup", "failed" if failing else "ended"]
    if failing:
        assert cup.endswith("it is so.")
        assert totals.startswith("1 ended, 1 failed; ")
        text = " ".join(printed.err.split())
        assert "1 of 2 objects have no result. " in text
        assert (printed.out + text).count("it is so.") == 1


def test_events_have_the_outcome_of_each_object(world, capsys):
    world.add("ball", "if tries < 1: os.abort()\nend()")
    given = [str(world.folder / "scans"), "-o", str(world.out), "--json", "--", "--stl"]
    assert main(["batch", *given]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [one["event"] for one in events] == ["start", "object-end", "result"]
    assert (events[1]["status"], events[1]["tries"]) == ("ended", 2)
    assert events[-1]["objects"] == 1


def test_names_and_messages_are_escaped_on_the_page(tmp_path):
    name = 'a<b>&"c" #1?'
    folder = tmp_path / name
    folder.mkdir()
    (folder / "overview.png").touch()
    (folder / "report.html").touch()
    (folder / "summary.json").write_text('{"faces": 12}')
    outcomes = [
        Outcome(name=name, status="ended", seconds=1.25),
        Outcome(name="x", status="failed", message="<script>"),
    ]
    write_table(outcomes, tmp_path, {name: "photos", "x": "scans/x"})
    page = (tmp_path / "batch.html").read_text()
    assert "<script>" not in page
    assert "<b>" not in page
    link = "a%3Cb%3E%26%22c%22%20%231%3F"
    assert f'<a href="{link}/report.html"><img loading="lazy" src="{link}/overview.png"' in page
    read = [*csv.DictReader((tmp_path / "batch.csv").open(newline=""))]
    assert [row["name"] for row in read] == [name, "x"]
    assert [row["faces"] for row in read] == ["12", ""]


def test_the_page_rounds_figures_and_has_each_reason_once(tmp_path):
    (tmp_path / "cup").mkdir()
    summary = {"views": 24, "registered": 23, "vertices": 86801, "peak_memory_mb": 1245.81640625}
    (tmp_path / "cup" / "summary.json").write_text(json.dumps(summary | {"seconds": 71.18979}))
    outcomes = [
        Outcome(name="cup", status="kept"),
        Outcome(name="jar", status="failed", message="scans/jar: 2 photographs; see `--masks`."),
        Outcome(name="jug", status="failed", message="scans/jug: 2 photographs; see `--masks`."),
        Outcome(name="pot", status="lost", message=f"{tmp_path / 'pot'}: it is full."),
    ]
    write_table(outcomes, tmp_path, {one.name: f"scans/{one.name}" for one in outcomes})
    page = (tmp_path / "batch.html").read_text()
    shown = ("23 of 24", "86,801", "71 s", "1,246 MB", "1 of 4 objects", "1 kept, 2 failed, 1 lost")
    assert all(f">{one}<" in page for one in shown)
    rows = re.findall(r'<tr><td class="text">(.*)</td><td class="text">(.*)</td></tr>', page)
    assert rows == [
        ("PHOTOS: 2 photographs; see <code>--masks</code>.", "jar, jug"),
        (f"{tmp_path / 'pot'}: it is full.", "pot"),
    ]
    assert "var(--bad)" in page  # the report's style
    (cup, *_) = csv.DictReader((tmp_path / "batch.csv").open(newline=""))
    assert (cup["seconds"], cup["peak_memory_mb"]) == ("71.2", "1245.8")


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1200])
def test_the_page_is_as_wide_as_the_window(tmp_path, width):
    """Long names and messages without spaces wrap."""
    sync_api = pytest.importorskip("playwright.sync_api")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    name = 60 * "name"
    outcomes = [
        Outcome(name=name, status="failed", message=f"{60 * 'path/'}: it is so."),
        Outcome(name="cup", status="lost", message="killed."),
    ]
    write_table(outcomes, tmp_path, {name: "photos", "cup": "cups"})
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": 800})
        page.goto((tmp_path / "batch.html").as_uri())
        inner = "[...document.querySelectorAll('.scroll')].map((one) => one.scrollWidth)"
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert all(one <= width for one in page.evaluate(inner))
        assert page.locator("#objects tr:visible").count() == (2 if width < 900 else 3)
        browser.close()
