"""Tables in documents are those of kept figures, which are of this version or nearly."""

import argparse
import json
import re
import tomllib
from pathlib import Path

import declared
import pytest
import tables
from declared import Place, Row, Study, Table, figure, listed

ROOT = Path(__file__).parents[2]
STUDIES = {name: tables.study_named(name) for name in tables.NAMES}
DOCUMENTS = (ROOT / "README.md", ROOT / "benchmarks" / "README.md", *(ROOT / "docs").glob("*.md"))
MARKER = re.compile(r"<!-- table: ([\w-]+) -->")
OLDEST = 2  # minor versions


def minor(version):
    first, second, *_ = map(int, version.split("."))
    return 100 * first + second


@pytest.mark.parametrize("name", STUDIES)
def test_figures_are_at_most_two_minor_versions_old(name):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    now = minor(project["project"]["version"])
    rows = tables.kept_rows(STUDIES[name])
    assert rows, f"nothing is measured: python benchmarks/studies/tables.py {name}"
    old = [" ".join(key) for key, row in rows.items() if now - minor(row["version"]) > OLDEST]
    assert not old, f"these rows are old: {old}; python benchmarks/studies/tables.py {name}"


@pytest.mark.parametrize("name", STUDIES)
def test_documents_show_the_kept_figures(name):
    rows = tables.kept_rows(STUDIES[name])
    for table in STUDIES[name].tables:
        (found,) = tables.block(table.name).findall((ROOT / table.document).read_text("utf-8"))
        advice = f"python benchmarks/studies/tables.py {name} --write"
        assert tables.markdown(table, rows) in found, advice


def test_every_marked_table_is_declared_once_and_shown_once():
    shown = [name for path in DOCUMENTS for name in MARKER.findall(path.read_text("utf-8"))]
    known = [table.name for study in STUDIES.values() for table in study.tables]
    assert sorted(shown) == sorted(known)


def test_pages_name_commands_that_exist():
    page = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
    commands = re.findall(r"^    python benchmarks/studies/tables\.py (.+)$", page, re.MULTILINE)
    assert {word for line in commands for word in line.split()} >= set(tables.NAMES)
    for line in commands:
        tables.options_of(line.split())


class Counted:
    """A study whose rows count how often they are measured."""

    def __init__(self, folder):
        self.folder, self.calls = folder, []
        self.photograph = folder / "photos" / "one.png"
        self.photograph.parent.mkdir(parents=True)
        self.photograph.write_bytes(b"first")
        rows = {("ours",): Row(measure=self.measure)}
        rows["theirs",] = Row(measure=self.measure, inputs=self.inputs)
        lines = listed(["method"], [figure("error, %", "error")])
        table = Table(name="counted", document="none.md", lines=lines)
        self.study = Study(name="counted", rows=rows, tables=[table])

    def inputs(self, place):
        place.photographs(self.folder, "photos")

    def measure(self, place):
        self.inputs(place)
        self.calls.append(len(self.calls))
        return {"error": 1 / 3}

    def options(self, **changed):
        given = {"only": "", "again": False, "tiny": True, "cache": self.folder}
        return argparse.Namespace(**given | {"figures": self.folder / "figures"} | changed)

    def run(self, monkeypatch, **changed):
        """Measure as the command does, without processes."""

        def measured(study, key, former, options):
            asked = argparse.Namespace(
                row=key,
                cache=options.cache,
                tiny=True,
                digest="" if former is None or options.again else former["digest"],
                out=self.folder / "row.json",
            )
            tables.measure_row(study, asked)
            told = json.loads(asked.out.read_text(encoding="utf-8"))
            return tables.record_of(key, told, former, 1.5)

        monkeypatch.setattr(tables, "measured", measured)
        before = len(self.calls)
        tables.measure_study(self.study, self.options(**changed))
        return len(self.calls) - before


def test_a_stopped_command_resumes_and_rivals_wait_for_other_photographs(monkeypatch, tmp_path):
    counted = Counted(tmp_path)
    assert counted.run(monkeypatch, only="ours") == 1
    assert counted.run(monkeypatch) == 1
    assert counted.run(monkeypatch) == 0
    assert counted.run(monkeypatch, again=True) == 2
    monkeypatch.setattr(tables, "version", lambda: "100.0.0")
    assert counted.run(monkeypatch) == 1  # theirs is kept
    rows = tables.kept_rows(counted.study, tmp_path / "figures")
    assert {row["version"] for row in rows.values()} == {"100.0.0"}
    monkeypatch.setattr(tables, "version", lambda: "101.0.0")
    counted.photograph.write_bytes(b"second")
    assert counted.run(monkeypatch) == 2


def test_a_table_has_figures_and_what_they_were_measured_with(monkeypatch, tmp_path):
    counted = Counted(tmp_path)
    counted.run(monkeypatch)
    (table,) = counted.study.tables
    rows = tables.kept_rows(counted.study, tmp_path / "figures")
    text = tables.markdown(table, rows)
    head = "| method | error, % |\n|---|--:|\n| ours | 0.33 |\n| theirs | 0.33 |\n\n*Version "
    assert text.startswith(head)
    assert rows["ours",]["figures"] == {"error": 0.3333}


def test_scenes_are_rendered_once_and_have_a_digest(monkeypatch, tmp_path):
    calls = []

    def render(name, folder, config):
        calls.append((name, config.num_views))
        (folder / "photos").mkdir(parents=True)
        (folder / "photos" / "a.png").write_bytes(name.encode())

    monkeypatch.setattr(declared, "render_scene", render)
    place = Place(cache=tmp_path)
    one, again = (place.scene("mug", num_views=9) for _ in range(2))
    other = place.scene("jar", num_views=9)
    assert one == again != other
    assert calls == [("mug", 9), ("jar", 9)]
    assert place.used[0] == place.used[1] != place.used[2]
    Place(cache=tmp_path, tiny=True).scene("mug", num_views=9)
    assert calls[-1] == ("mug", 8)
