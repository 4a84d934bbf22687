"""What is shown of a batch: lines, events, and the table."""

import csv
import io
import json

import pytest
from rich.console import Console

from pimper_torch.cli.batches.cli import Lines
from pimper_torch.cli.batches.table import rows_of, write_table
from pimper_torch.cli.batches.task import Outcome
from pimper_torch.cli.main import main


def test_a_line_tells_where_an_object_is_and_how_it_ended(monkeypatch):
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=True, width=120)
    monkeypatch.setattr("pimper_torch.cli.batches.cli.Console", lambda **_: console)
    lines = Lines(True)
    name = "cup [/]"
    with lines:
        lines.progressed(name, {"event": "try", "place": "tcp://far"})
        lines._progress.refresh()
        lines.progressed(name, {"event": "stage-begin", "stage": "fuse", "seconds_left": 41.2})
        lines._progress.refresh()
        lines.settled(Outcome(name=name, status="lost", message="killed.", place="far"), True)
    text = shown.getvalue()
    for told in (name, "on tcp://far", "fuse, about 41 s left", "lost, is tried again", "killed."):
        assert told in text


@pytest.mark.parametrize("failing", [True, False])
def test_the_command_shows_a_table_and_its_exit_code_tells_of_failures(world, capsys, failing):
    world.add("ball")
    world.add("cup", "fail('InputError', 2)" if failing else "end()")
    code = main(["batch", str(world.folder / "scans"), "-o", str(world.out), "--jobs", "1"])
    told = capsys.readouterr()
    assert code == (2 if failing else 0)
    head, ball, cup, totals = told.out.splitlines()
    assert head.split() == ["name", "status", "tries", "seconds", "registered", "faces"]
    assert ball.split()[:3] == ["ball", "ended", "1"]
    assert ball.endswith(" 99")
    if failing:
        assert cup.split()[:2] == ["cup", "failed"]
        assert totals.startswith("1 ended, 1 failed; ")
        assert "1 of 2 objects have no result, as cup: it is so." in " ".join(told.err.split())


def test_events_tell_every_try(world, capsys):
    world.add("ball", "if tries < 1: os.abort()\nend()")
    given = [str(world.folder / "scans"), "-o", str(world.out), "--json", "--", "--stl"]
    assert main(["batch", *given]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [one["event"] for one in events] == [
        "start",
        *("object-begin", "object-stage", "object-end") * 2,
        "result",
    ]
    assert [one["again"] for one in events if one["event"] == "object-end"] == [True, False]
    assert events[-1]["objects"] == 1


def test_names_and_messages_are_text_on_the_page(tmp_path):
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
    rows = rows_of(outcomes, tmp_path, {name: "photos", "x": "photos"})
    write_table(rows, tmp_path)
    page = (tmp_path / "batch.html").read_text()
    assert "<script>" not in page
    assert "<b>" not in page
    link = "a%3Cb%3E%26%22c%22%20%231%3F"
    assert f'<a href="{link}/report.html"><img loading="lazy" src="{link}/overview.png"' in page
    read = [*csv.DictReader((tmp_path / "batch.csv").open(newline=""))]
    assert [row["name"] for row in read] == [name, "x"]
    assert [row["faces"] for row in read] == ["12", ""]
