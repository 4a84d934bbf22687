"""Measure the tables of the documents, and write them there.

    python benchmarks/studies/tables.py all
    python benchmarks/studies/tables.py NAME [NAME ...] [--only TEXT] [--again]
    python benchmarks/studies/tables.py all --list

Every row is measured in a process of its own, and kept in ``benchmarks/figures/NAME.json`` as soon
as it is measured, with version, commit and processor: a command that was stopped resumes. Rows are
measured again for a new version of the package; those of other programs only if their photographs
change. Tables are written between ``<!-- table: NAME -->`` and ``<!-- end -->``.
"""

import argparse
import importlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from declared import Figures, Key, Place, Study, Table

from pimper_bench.table.measure import this_machine
from pimper_torch.runtime.user_cache import user_cache

# In the order in which they are measured.
NAMES = (
    "comparison",
    "capture_modes",
    "ingredients",
    "strangers",
    "cameras",
    "lights",
    "priors",
    "file_encodings",
    "sfm",
    "walk",
    "normal_integration",
    "gamma",
    "gradients",
    "gradient_cost",
    "growth",
)
ROOT = Path(__file__).parents[2]
FIGURES = ROOT / "benchmarks" / "figures"
Record = dict[str, Any]


def study_named(name: str) -> Study:
    """Return the declaration of a study."""
    if (helpers := str(ROOT / "tests" / "helpers")) not in sys.path:
        sys.path.append(helpers)
    return importlib.import_module(name).STUDY


def version() -> str:
    """Return the version of the package in this repository."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return project["project"]["version"]


def commit() -> str:
    """Return the last commit of the package's code, with a plus if files differ from it."""
    code = ("--", "pimper_torch", "configs")
    told = {}
    for words in (("log", "-1", "--format=%h", "--abbrev=8"), ("status", "--porcelain")):
        ran = subprocess.run(("git", *words, *code), cwd=ROOT, capture_output=True, text=True)
        told[words[0]] = ran.stdout.strip()
    return told["log"] + "+" * bool(told["status"])


def kept_rows(study: Study, folder: Path = FIGURES) -> dict[Key, Record]:
    """Read the kept rows of a study, in the order of its declaration."""
    path = folder / f"{study.name}.json"
    rows = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    known = {tuple(row["key"]): row for row in rows}
    return {key: known[key] for key in study.rows if key in known}


def keep(study: Study, rows: Mapping[Key, Record], folder: Path) -> None:
    """Write the rows of a study."""
    folder.mkdir(exist_ok=True)
    path = folder / f"{study.name}.json"
    ordered = [rounded(rows[key]) for key in study.rows if key in rows]
    part = path.with_suffix(".part")
    part.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    part.replace(path)


def rounded(value: Any) -> Any:  # noqa: ANN401 - anything that JSON has
    """Return a value with four significant digits in every float."""
    if isinstance(value, Mapping):
        return {name: rounded(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(each) for each in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def needed(row: Record | None, again: bool) -> bool:
    """Return whether a row has to be measured, or a rival's to be looked at."""
    return again or row is None or row["version"] != version()


def measured(study: Study, key: Key, former: Record | None, options: argparse.Namespace) -> Record:
    """Measure a row in a process of its own; a rival's of the same photographs is kept.

    Raises:
        RuntimeError: The process failed; with the end of what it printed.
    """
    with tempfile.TemporaryDirectory(prefix="pimper-row-") as folder:
        out = Path(folder) / "row.json"
        digest = "" if former is None or options.again else former["digest"]
        command = [sys.executable, __file__, study.name, "--row", *key, "--out", str(out)]
        command += ["--digest", digest, "--cache", str(options.cache)]
        log = Path(folder) / "log"
        with log.open("w") as printed:
            process = subprocess.Popen(
                command + ["--tiny"] * options.tiny, stdout=printed, stderr=printed
            )
            try:
                _, status, usage = os.wait4(process.pid, 0)
            except BaseException:  # the command is stopped, and its row, too
                process.terminate()
                raise
            process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise RuntimeError(log.read_text(encoding="utf-8", errors="replace").strip()[-600:])
        told = json.loads(out.read_text(encoding="utf-8"))
    return record_of(key, told, former, usage.ru_utime + usage.ru_stime)


def record_of(key: Key, told: Record, former: Record | None, seconds: float) -> Record:
    """Return a row with version, commit, processor and cores, or a rival's that is kept."""
    if told["figures"] is None:
        assert former is not None
        return former | {"version": version()}
    machine = this_machine()
    return {
        "key": [*key],
        "version": version(),
        "commit": commit(),
        "processor": machine.cpu,
        "cores": machine.cores,
        "digest": told["digest"],
        "CPU s": seconds,
        "figures": told["figures"],
    }


def measure_row(study: Study, options: argparse.Namespace) -> None:
    """Measure a row here, and write it for the process that asked."""
    row, place = study.rows[tuple(options.row)], Place(cache=options.cache, tiny=options.tiny)
    figures: Figures | None = None
    if row.inputs is not None:
        row.inputs(place)
    digest = ", ".join(dict.fromkeys(place.used))
    if row.inputs is None or digest != options.digest:
        figures = row.measure(place)
        digest = ", ".join(dict.fromkeys(place.used))
    told = json.dumps({"digest": digest, "figures": figures})
    options.out.write_text(told, encoding="utf-8")


def markdown(table: Table, rows: Mapping[Key, Record]) -> str:
    """Return a table with the line that says what it was measured with."""
    rows = table.shown(rows)
    head, *lines = table.lines({key: row["figures"] for key, row in rows.items()})
    rule = ["---" if index < table.labels else "--:" for index in range(len(head))]
    body = (f"| {' | '.join(cells)} |" for cells in lines)
    text = "\n".join((f"| {' | '.join(head)} |", f"|{'|'.join(rule)}|", *body))
    return "\n\n".join(filter(None, (text, provenance(rows))))


def provenance(rows: Mapping[Key, Record]) -> str:
    """Return versions, commits and processors of rows in one line.

    A row of an earlier version may have a note: on what it was measured, if not on the same.
    """
    told = dict.fromkeys(
        f"Version {row['version']}, commit {row['commit']}; {row['processor']}, "
        f"{row['cores']} core{'s' * (row['cores'] != 1)}{row.get('note', '')}."
        for row in rows.values()
    )
    return f"*{' '.join(told)}*" if told else ""


def block(name: str) -> re.Pattern[str]:
    """Return the pattern of a table in a document, with its markers."""
    return re.compile(rf"<!-- table: {name} -->\n.*?<!-- end -->", flags=re.DOTALL)


def write_tables(study: Study) -> None:
    """Write the tables of a study into their documents, as far as rows are kept."""
    rows = kept_rows(study)
    for table in study.tables if rows else ():
        path = ROOT / table.document
        text = path.read_text(encoding="utf-8")
        fresh = f"<!-- table: {table.name} -->\n\n{markdown(table, rows)}\n\n<!-- end -->"
        changed, count = block(table.name).subn(lambda _, fresh=fresh: fresh, text)
        if count != 1:
            say(f"{table.document} has {count} places for the table {table.name}.")
        elif changed != text:
            path.write_text(changed, encoding="utf-8")


def measure_study(study: Study, options: argparse.Namespace) -> None:
    """Measure the rows of a study that are missing or of another version, then write its tables."""
    rows = kept_rows(study, options.figures)
    for key in study.rows:
        former, name = rows.get(key), " ".join(key)
        if options.only not in name or not needed(former, options.again):
            continue
        try:
            rows[key] = measured(study, key, former, options)
        except RuntimeError as error:
            say(f"{study.name}: {name} failed: {error}")
            continue
        keep(study, rows, options.figures)
        say(f"{study.name}: {name}, {rows[key]['CPU s']:.0f} CPU s")
    if options.tiny:
        say("\n".join(markdown(table, rows) for table in study.tables))
    else:
        write_tables(study)


def state(study: Study) -> str:
    """Return a study's rows and their versions in one line."""
    rows = kept_rows(study)
    versions = ", ".join(dict.fromkeys(row["version"] for row in rows.values())) or "none"
    seconds = sum(row["CPU s"] for row in rows.values())
    tables = ", ".join(table.name for table in study.tables)
    counts = f"{len(rows)} of {len(study.rows)} rows"
    return f"{study.name}: {counts}, version {versions}, {seconds:.0f} CPU s; tables {tables}"


def say(line: str) -> None:
    """Write a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def options_of(arguments: list[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="+", choices=("all", *NAMES), metavar="NAME")
    parser.add_argument("--only", default="", metavar="TEXT", help="rows whose key contains it")
    parser.add_argument("--again", action="store_true", help="also rows of this version")
    parser.add_argument("--write", action="store_true", help="write kept figures, measure nothing")
    parser.add_argument("--list", action="store_true", help="print what is kept, measure nothing")
    parser.add_argument("--cache", type=Path, help="folder of scenes, cameras and surfaces")
    parser.add_argument("--tiny", action="store_true", help=argparse.SUPPRESS)  # for tests
    for name in ("--row", "--out", "--digest"):  # of the process of one row
        parser.add_argument(name, nargs="+" if name == "--row" else None, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    options.figures = FIGURES if not options.tiny else options.cache / "figures"
    options.cache = options.cache or user_cache() / "tables"
    options.out = options.out and Path(options.out)
    return options


def main(arguments: list[str] | None = None) -> None:
    """Measure, list or write the studies of the command line."""
    options = options_of(arguments)
    names = NAMES if "all" in options.names else options.names
    for study in map(study_named, names):
        if options.row:
            measure_row(study, options)
        elif options.list:
            say(state(study))
        elif options.write:
            write_tables(study)
        else:
            measure_study(study, options)
            if study.draw is not None and not options.tiny:
                study.draw(Place(cache=options.cache), ROOT / study.picture)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # ends the process of a row, too
    main()
