import io
import json
import math
import platform
import re
from pathlib import Path

import pytest
import torch
from rich.console import Console

from pimper_bench.baselines.missing import MissingProgramError
from pimper_bench.table.bench_table import (
    MISSING,
    PUBLISHED,
    BenchRow,
    Table,
    columns,
    markdown,
    row_of_failure,
    terminal,
    with_published,
    write_json,
)
from pimper_bench.table.measure import Machine, this_machine
from pimper_torch.runtime.config import build
from pimper_torch.runtime.cores import usable_cores
from pimper_torch.runtime.errors import ReconstructionError

MACHINE = Machine(
    cpu="Abacus 12",
    cores=2,
    memory_gb=23.4,
    gpu="",
    system="Linux",
    python="3.11.7",
    versions=("torch 2.13.0",),
)
FULL = BenchRow(
    scene="mug",
    method="default",
    mesh_points=251,
    triangles=480,
    samples=6_690_000,
    missing_percent=24.7,
    minutes=1.5,
    sfm_minutes=0.25,
    relative_error=1.234567,
    coverage_percent=99.0,
    mean_normal_deg=2.5,
    median_normal_deg=1.75,
    mean_shape_normal_deg=3.5,
    median_shape_normal_deg=2.25,
    common_percent=72.0,
    common_relative_error=0.75,
    common_mean_normal_deg=1.5,
    common_median_normal_deg=0.25,
    common_mean_shape_normal_deg=1.25,
    common_median_shape_normal_deg=0.125,
    pitted_percent=0.5,
    chamfer=0.125,
    accuracy=0.1,
    completeness=0.15,
    completeness_seen=0.14,
    f_scores=((0.5, 97.5), (1.0, 99.25)),
    peak_memory_mb=1234.0,
)
EMPTY = BenchRow(scene="mug", method="pmvs", note="not installed: pmvs2")


def table(*rows, **settings):
    return Table(
        rows=rows, machine=MACHINE, date="2026-11-21T10:00", scale="quick", settings=settings
    )


def cells(text):
    """Return the rows of the Markdown table by heading."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    split = [[word.strip() for word in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    return [dict(zip(split[0], line, strict=True)) for line in split[2:]]


def test_missing_values_are_dashes():
    full, empty = cells(markdown(table(FULL, EMPTY)))
    words = {"scene": "mug", "method": "pmvs", "note": "not installed: pmvs2"}
    assert empty == dict.fromkeys(full, MISSING) | words
    assert MISSING not in [full[name] for name in full.keys() - words.keys()]


def test_every_figure_is_in_its_column():
    (full,) = cells(markdown(table(FULL)))
    assert full == {
        "scene": "mug",
        "method": "default",
        "points": "251",
        "triangles": "480",
        "samples, M": "6.69",
        "missing, %": "24.7",
        "minutes": "1.5",
        "SfM, min": "0.2",
        "memory, MB": "1,234",
        "3D error, %": "1.23",
        "covered, %": "99.0",
        "normals, °": "2.50",
        "median, °": "1.75",
        "shape, °": "3.50",
        "shape median, °": "2.25",
        "pitted, %": "0.50",
        "covered by all, %": "72.0",
        "3D error there, %": "0.75",
        "normals there, °": "1.50",
        "median there, °": "0.25",
        "shape there, °": "1.25",
        "shape median there, °": "0.12",
        "Chamfer, %": "0.125",
        "accuracy, %": "0.100",
        "complete, %": "0.140",
        "F 0.5 %": "97.5",
        "F 1 %": "99.2",
    }


def test_markdown_lines_have_equal_width_and_numbers_are_right_aligned():
    text = markdown(table(FULL, EMPTY, FULL.replace(method="a much longer name", minutes=123.0)))
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len({len(line) for line in lines}) == 1
    rule = lines[1].split("|")[1:-1]
    assert [word.strip().endswith(":") for word in rule] == [False] * 2 + [True] * 25 + [False]


def test_empty_columns_are_omitted():
    bare = FULL.replace(f_scores=(), chamfer=None, relative_error=math.nan)
    assert [len(part) for part in columns([bare, EMPTY]).values()] == [7, 6, 6, 2]


def test_different_thresholds_have_separate_columns():
    rows = (FULL, FULL.replace(method="paper", f_scores=((0.25, 50.0), (1.0, 60.0))))
    first, second = cells(markdown(table(*rows)))
    assert (first["F 0.25 %"], first["F 0.5 %"], first["F 1 %"]) == (MISSING, "97.5", "99.2")
    assert (second["F 0.25 %"], second["F 0.5 %"], second["F 1 %"]) == ("50.0", MISSING, "60.0")


def test_names_and_notes_are_escaped_in_the_table():
    odd = BenchRow(
        scene="a|b", method="x\ny", minutes=1.0, note="failed: one | two\nIts last lines:"
    )
    (row,) = cells(markdown(table(odd)))
    assert row["scene"] == "a\\|b"
    assert row["method"] == "x y"
    assert row["note"] == "failed: one \\| two"
    long = BenchRow(scene="mug", method="m", minutes=1.0, note="word " * 50)
    assert len(cells(markdown(table(long)))[0]["note"]) <= 60


def test_published_rows_come_first_and_are_marked():
    ours = [FULL, FULL.replace(scene="potatoes"), FULL.replace(method="paper"), FULL]
    rows = with_published(ours)
    assert [(row.scene, row.published) for row in rows] == [
        ("mug", True),
        ("mug", False),
        ("mug", False),
        ("mug", False),
        ("potatoes", True),
        ("potatoes", True),
        ("potatoes", False),
    ]
    text = markdown(table(*rows))
    assert cells(text)[0]["method"] == "PiMPeR †"
    assert cells(text)[1]["method"] == "default"
    assert "† As published, on other photographs" in text
    assert "†" not in markdown(table(FULL))


def test_published_figures_are_shown_as_printed():
    shown = {(one["scene"], one["method"]): one for one in cells(markdown(table(*PUBLISHED)))}
    mug = shown["mug", "PiMPeR †"]
    assert [mug[name] for name in ("samples, M", "missing, %", "3D error, %")] == [
        "6.69",
        "24.7",
        "7.10",
    ]
    assert shown["potatoes", "global-stereo †"]["minutes"] == "1,320.0"  # 22 hours


def test_the_legend_names_the_machine():
    text = markdown(table(FULL, seed=3))
    assert "Scale quick, 2026-11-21T10:00, on Abacus 12, 2 cores, 23 GB; Linux" in text
    assert "torch 2.13.0; seed 3." in text


def printed(shown, width):
    console = Console(file=io.StringIO(), width=width)
    console.print(shown)
    return console.file.getvalue()


def test_the_terminal_shows_the_same_cells_within_its_width():
    text = printed(terminal(table(*with_published([FULL]))), 80)
    assert "…" not in text
    for word in ("PiMPeR †", "6.69", "24.7", "1,234", "1.23", "0.125", "99.2"):
        assert word in text
    assert text.count("default") == 4
    assert text.count("PiMPeR") == 2  # surface distances were not published


def test_the_terminal_gives_the_full_reason_of_missing_figures():
    note = "failed: one\nIts last lines:\n  [red]two[/red] " + "word " * 30
    odd = EMPTY.replace(method="[b]pmvs[/b]", note=note)
    text = printed(terminal(table(FULL, odd)), 60)
    assert "mug, [b]pmvs[/b]: failed: one" in text
    assert "[red]two[/red]" in text
    assert text.count("word") == 30


def test_json_has_every_field_and_null_for_nan(tmp_path):
    before = table(FULL, EMPTY, *PUBLISHED, seed=3, scenes=["mug", "jar"])
    write_json(before, tmp_path / "bench.json")
    report = json.loads((tmp_path / "bench.json").read_text())
    assert report["settings"] == {"seed": 3, "scenes": ["mug", "jar"]}
    assert [build(BenchRow, row, "row") for row in report["rows"]] == [*before.rows]
    assert build(Machine, report["machine"], "machine") == MACHINE
    write_json(table(FULL.replace(minutes=math.nan, chamfer=math.inf)), tmp_path / "bench.json")
    (row,) = json.loads((tmp_path / "bench.json").read_text())["rows"]
    assert row["minutes"] is row["chamfer"] is None


def test_a_missing_program_is_distinguished_from_a_failure():
    missing = row_of_failure("mug", "pmvs", MissingProgramError("pmvs2 is not on the PATH"))
    assert missing.note == "not installed\npmvs2 is not on the PATH"
    failed = row_of_failure("mug", "paper", ReconstructionError("no facet"), minutes=0.5)
    assert failed.note == "failed: no facet"
    assert failed.minutes == 0.5
    assert row_of_failure("mug", "paper", MemoryError()).note == "failed: MemoryError"


def test_this_machine_is_described():
    machine = this_machine()
    assert machine.cores == usable_cores()
    memory_kib = re.search(r"MemTotal: +(\d+) kB", Path("/proc/meminfo").read_text())[1]
    assert machine.memory_gb == pytest.approx(int(memory_kib) / 2**20, abs=0.06)  # one decimal
    assert f"torch {torch.__version__}" in machine.versions
    assert machine.python == platform.python_version()
    assert machine.cpu
    assert machine.cpu in machine.summary
