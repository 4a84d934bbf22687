"""Judge silhouettes and surfaces over a fleet of rendered captures.

    python benchmarks/studies/fleet.py --out DIR [--outlines] [--only NAME ...] [--tag TAG]
    python benchmarks/studies/fleet.py --out DIR --table TAG [TAG]

Eleven shapes on three paths in four materials, 24 photographs of 640x480 each; by default a Latin
square of them. Captures are rendered once. Their cameras for silhouettes are estimated once, for
all versions of the package, and kept in ``DIR/captures/NAME/cameras``. Rows are kept in
``DIR/rows/TAG``, and the same command resumes; ``--outlines`` stops at silhouettes. A result is
good if its normals are at most 6 degrees off and it covers 96 % of the object's pixels; every other
one should be announced.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator, Mapping
from fnmatch import fnmatch
from itertools import chain, product
from pathlib import Path
from typing import Any

import torch
from fleet_captures import MESHES, SUBSET, fleet, rendered
from silhouettes import known_masks, overlaps

from pimper_bench.datasets import read_rendered
from pimper_bench.metrics.estimates import read_estimate
from pimper_bench.metrics.in_view import compare_along_rays
from pimper_bench.metrics.similarity import align_estimate, transfer
from pimper_bench.metrics.surface_distances import TrueSurface
from pimper_torch.chains.prepare import locate
from pimper_torch.export.result_folder.marker import STAGES
from pimper_torch.io.photographs import load_views
from pimper_torch.presets.load_chain import load_chain
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.runtime.errors import InputError, PimperWarning, ReconstructionError
from pimper_torch.stages.sfm.reconstruct import placed_scene, structure_from_motion
from pimper_torch.stages.silhouettes.find import FindSilhouettes
from pimper_torch.stages.silhouettes.network import SilhouetteNetwork, load_network
from pimper_torch.stages.verdict.judge import score_of
from pimper_torch.store import Store, kept

Row = dict[str, Any]

MOST_DEG, LEAST_MET = 6.0, 96.0  # of a good result: normals, per cent of pixels met
# Parts of warnings that call the result bad; others are notes.
ANNOUNCING = (
    *("is treated as the object", "have no point in common"),
    *("cameras are unreliable", "may be misplaced", "Give masks of the object"),
    *("Features hardly match", "No points", "keep the normals of the coarse mesh"),
)
MOST_LOST = 0.2  # of the photographs may be excluded or fail without announcement
COLUMNS = (
    *("IoU", "worst", "expected", "lost %", "extra %", "reliable", "CPU s"),
    *("normals °", "met %", "accuracy %", "completeness %", "score", "good", "announced", "error"),
)


def outlines(place: Path, preset: str, network: SilhouetteNetwork | None) -> Row:
    """Find the silhouettes of a capture, and compare them with the true masks."""
    views, method = load_views(place / "photos"), load_chain(preset)
    with warnings.catch_warnings(record=True) as cautions:
        warnings.simplefilter("always", PimperWarning)
        config, store = method.reconstruct.config, Store(folder=place / "cameras")
        key = Path(preset).stem
        model, _ = kept(store, key, SparseModel, lambda: structure_from_motion(views, config))
        scene, _ = locate(method, method.running(), placed_scene(views, model))
        began = time.process_time()
        found = FindSilhouettes(method.silhouettes.config, network)(scene)
        seconds = time.process_time() - began
    told = {
        "views": views.num_views,
        "registered": scene.views.num_views,
        "diagnosis": scene.diagnosis,
        "warnings": [str(each.message) for each in cautions],
    }
    known = known_masks(str(place / "masks"), scene)
    figures = compared(found.masks, torch.stack(known))
    if found.expected_overlap is not None:
        figures["expected"] = float(found.expected_overlap.mean())
        told["verdict"] = {"score": score_of("expected_overlap", figures["expected"])}
    reliable = f"{int(found.reliable.sum())} of {views.num_views}"
    return told | figures | {"reliable": reliable, "announced": announced(told), "CPU s": seconds}


def compared(found: torch.Tensor, known: torch.Tensor) -> Row:
    """Return the overlaps of masks, and the per cent of the true area lost and in excess."""
    each, area = overlaps(found, list(known)), known.sum()
    return {
        "IoU": float(each.mean()),
        "worst": float(each.min()),
        "lost %": float(100 * (known & ~found).sum() / area),
        "extra %": float(100 * (found & ~known).sum() / area),
    }


def announced(told: Mapping[str, Any]) -> bool:
    """Return whether ``summary.json`` says that the result is bad: its verdict, or a warning."""
    if (told.get("verdict") or {}).get("score", 1.0) < 0.5:
        return True
    failures = [each["names"] for each in told.get("failures", ()) if each["what"] == "view"]
    missing = max(len({*chain.from_iterable(failures)}), told["views"] - told["registered"])
    counted = any(part in text for text in told["warnings"] for part in ANNOUNCING)
    return bool(told["diagnosis"]) or counted or missing > MOST_LOST * told["views"]


def reconstructed(place: Path, result: Path, preset: str) -> Row:
    """Run ``pimper reconstruct``, and return entries of its summary with CPU seconds."""
    command = [sys.executable, "-m", "pimper_torch", "reconstruct", str(place / "photos")]
    command += ["-o", str(result), "--preset", preset, "--overwrite", "--quiet"]
    before = os.times()
    ran = subprocess.run(command, capture_output=True, text=True)
    after = os.times()
    if ran.returncode:
        error = ReconstructionError if ran.returncode == 2 else RuntimeError
        raise error(ran.stderr.strip()[-500:])
    shutil.rmtree(result / STAGES, ignore_errors=True)  # of use only to an interrupted run
    told = json.loads((result / "summary.json").read_text(encoding="utf-8"))
    entries = ("views", "registered", "diagnosis", "failures", "warnings", "vertices")
    row = {name: told[name] for name in entries} | {"score": told["verdict"]["score"]}
    row |= {"PSNR": told["relighting"]["psnr_db"], "GB": told["peak_memory_mb"] / 2**10}
    return row | {"announced": announced(told), "CPU s": sum(after[2:4]) - sum(before[2:4])}


def measured(place: Path, result: Path) -> Row:
    """Compare a result with the truth; normals and coverage over all photographs."""
    capture, estimate = read_rendered(place, photographs=False), read_estimate(result)
    moved = align_estimate(estimate, capture, "cameras", generator=torch.Generator())
    mesh = transfer(estimate.mesh, moved.truth_from_world)
    surface = TrueSurface(capture).compare(mesh)
    angles, met, pixels = 0.0, 0.0, float(capture.truth.foreground.sum())
    for view in range(capture.views.num_views):
        try:
            figures = compare_along_rays(mesh, capture, view)
        except InputError:  # nothing of the object is met
            continue
        met += figures.coverage * figures.pixels
        angles += figures.coverage * figures.pixels * figures.shape_normals.mean_deg
    return {
        "normals °": angles / met if met else 90.0,
        "met %": 100 * met / pixels,
        "accuracy %": surface.accuracy.mean_percent if surface.accuracy else None,
        "completeness %": surface.seen.completeness.mean_percent if surface.seen else None,
    }


def judged(
    row: Row,
    place: Path,
    result: Path | None,
    preset: str,
    network: SilhouetteNetwork | None = None,
) -> Row:
    """Add to a row what it lacks: silhouettes, and the surface if a folder is given for it."""
    try:
        if "IoU" not in row:
            row |= outlines(place, preset, network)
        if result is not None:
            row |= reconstructed(place, result, preset)
            row |= measured(place, result)
            row["good"] = row["normals °"] <= MOST_DEG and row["met %"] >= LEAST_MET
    except Exception as error:
        row["error"] = f"{type(error).__name__}: {' '.join(str(error).split())}"
        row["announced"] = isinstance(error, ReconstructionError) or row.get("announced", False)
        row["good"] = False
    return row


def cell(row: Row, name: str) -> str:
    """Return a figure as text."""
    value = row.get(name)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3f}"
    return ("-" if value is None else str(value)).replace("|", "/")[:80]


def table(tags: Mapping[str, Mapping[str, Row]]) -> Iterator[str]:
    """Format the rows of tags side by side, then their summaries."""
    names = dict.fromkeys(name for rows in tags.values() for name in rows)
    every = {name: [rows.get(name, {}) for rows in tags.values()] for name in names}
    used = [name for name in COLUMNS if any(name in row for rows in every.values() for row in rows)]
    yield f"| {' / '.join(tags)} | {' | '.join(used)} |"
    yield "|---|" + "--:|" * len(used)
    for name, rows in every.items():
        cells = (" / ".join(cell(row, column) for row in rows) for column in used)
        yield f"| {name} | {' | '.join(cells)} |"
    yield ""
    yield from (f"{tag}: {summary(rows)}" for tag, rows in tags.items())


def summary(rows: Mapping[str, Row]) -> str:
    """Return the counts of good and announced captures, and the overlap of silhouettes."""
    text = f"{len(rows)} captures"
    for word, wanted in (("good", True), ("bad", False)):
        part = [row for row in rows.values() if row.get("good") is wanted]
        text += f", {len(part)} {word} ({sum(row['announced'] for row in part)} announced)"
    found = {name: row["IoU"] for name, row in rows.items() if "IoU" in row}
    if found:
        worst = min(found, key=lambda name: found[name])
        text += f", IoU {sum(found.values()) / len(found):.3f}, worst {found[worst]:.3f} ({worst})"
    return text


def options_of(arguments: list[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of all files")
    parser.add_argument("--meshes", type=Path, default=MESHES, help="folder of mesh files")
    parser.add_argument("--outlines", action="store_true", help="stop at silhouettes")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--weights", type=Path, help="of silhouettes, for --outlines only")
    parser.add_argument("--all", action="store_true", help="every shape, path and material")
    parser.add_argument("--subset", action="store_true", help="six captures")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="names or patterns")
    parser.add_argument("--tag", help="of the rows; the commit by default")
    parser.add_argument("--table", nargs="+", metavar="TAG", help="print kept rows, run nothing")
    parser.add_argument("--tiny", action="store_true", help=argparse.SUPPRESS)  # for tests
    return parser.parse_args(arguments)


def say(line: str) -> None:
    """Write a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> None:
    """Judge the captures that have no row yet, and print the table."""
    options = options_of(arguments)
    wanted = SUBSET if options.subset else options.only or ("*",)
    names = [name for name in fleet(options.all) if any(fnmatch(name, one) for one in wanted)]
    git = ("git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty")
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip()
    tag, out = options.tag or commit or "now", options.out
    network = options.weights and load_network(options.weights)
    for name in () if options.table else names:
        path = out / "rows" / tag / f"{name}.json"
        row = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        if "good" in row or ("IoU" in row and options.outlines):
            continue
        place = rendered(name, options.tiny, options.meshes, out)
        result = None if options.outlines else out / "results" / name
        row = judged(row, place, result, options.preset, network)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_suffix(".part").write_text(json.dumps(row, indent=1), encoding="utf-8")
        path.with_suffix(".part").rename(path)
        say(f"{name}: " + ", ".join(f"{one} {cell(row, one)}" for one in COLUMNS if one in row))
    kept_rows: dict[str, dict[str, Row]] = {one: {} for one in options.table or (tag,)}
    for one, name in product(kept_rows, names):
        path = out / "rows" / one / f"{name}.json"
        if path.exists():
            kept_rows[one][name] = json.loads(path.read_text(encoding="utf-8"))
    say("\n".join(table(kept_rows)))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # ends the child process, too
    main()
