"""Measure the data that guards remove from plain photographs, and their gain where needed.

    python benchmarks/studies/guards.py FOLDER [--presets fast default] [--sets NAME ...] [--tiny]
    python benchmarks/studies/guards.py FOLDER --without extract.borders [--sets NAME ...]
    python benchmarks/studies/guards.py FOLDER --table

Every set is rendered once into FOLDER, run with a listener of removals, and compared with the
truth. Data is valid, and its removal wrong, in these cases: a photograph that was not degraded;
faces, facets and points near the true surface; pixels of the object. A warning is wrong if the
cameras are good. Features and matches are only counted. Results are kept, one JSON per run, under
set, preset and key; the same command resumes an interrupted run.
"""

import argparse
import json
import math
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from guard_sets import SETS, prepared
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_bench.datasets import read_rendered
from pimper_bench.metrics.evaluation import camera_figures
from pimper_bench.metrics.in_view import compare_along_rays
from pimper_bench.metrics.similarity import align_estimate, transfer
from pimper_bench.metrics.surface_distances import TrueSurface, true_surface
from pimper_bench.truth import Capture
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.rigid import transform
from pimper_torch.io.photographs import load_views
from pimper_torch.presets.load_chain import load_chain
from pimper_torch.records import Estimate, Reconstruction, Removal
from pimper_torch.runtime.errors import PimperError
from pimper_torch.runtime.events import Event
from pimper_torch.runtime.ledger import GUARDS, RemovedElements
from pimper_torch.runtime.stream import Emit, listening

# A position is correct within this fraction of the object's diagonal: five times the error of
# accurate surfaces. Cameras are good within these errors; all choices.
NEAR, MOST_DEG, MOST_PERCENT = 0.005, 1.0, 2.0
SAMPLES = 5_000  # positions of an entry that are compared with the truth

# Of a run, in the order of the table; covered and normals in the middle view. Bars of the
# meshes under a lamp: 98 % covered, normals of 5 degrees, 1 % sticking out.
FIGURES = (
    *("rotation_deg", "centre_percent", "accuracy_percent", "chamfer_percent"),
    *("covered_percent", "normals_deg", "sticking_out_percent"),
)


def nothing(like: int) -> Callable[..., Tensor]:
    """Return a guard that marks none of its argument number ``like``."""
    return lambda *given, **_: torch.zeros(len(given[like]), dtype=torch.bool)


def everything(like: int) -> Callable[..., Tensor]:
    """Return a guard that marks all of its argument number ``like``."""
    return lambda *given, **_: torch.ones(len(given[like]), dtype=torch.bool)


# The replacement of each guard that can be switched off, and the settings that switch it off.
PATCHES: dict[str, dict[str, object]] = {
    "sfm.static_background": {"stages.sfm.static_background.StaticBackground.detected": False},
    "sfm.moved_object": {"stages.sfm.registration.link_sessions": lambda *_: ()},
    "sfm.weak_views": {"stages.sfm.registration.drop_weak_views": lambda model, _: model},
    "sfm.misplaced": {"stages.sfm.diagnose._MIN_AGREEMENT": 0.0},
    "sfm.sound_views": {"chains.prepare.sound": lambda scene: scene},
    "silhouettes.empty": {
        "stages.silhouettes.find._without_empty": lambda silhouettes, _: silhouettes
    },
    "silhouettes.shadows": {"stages.silhouettes.cuts._without_shadow": lambda mask, *_: mask},
    "coarse.seen_through": {"stages.coarse.trim._MIN_BEHIND": 10**9},
    "remesh.data": {"stages.coarse.remesh._with_data": everything(1)},
    "fuse.outvoted": {
        "stages.fusion.blend._agreement": lambda found, *_: torch.ones_like(found.height)
    },
    "repair": {"stages.meshing.repair.Repair.forward": lambda _, surface: surface},
    "extract.spikes": {
        "stages.meshing.faults.Faults.folded_over": lambda found, *_: nothing(0)(found.faces),
        "stages.meshing.faults.Faults.stretched": lambda found, *_: nothing(0)(found.faces),
    },
    "extract.borders": {"stages.meshing.extract.protruding": nothing(1)},
}
CHANGES: dict[str, dict[str, object]] = {
    "photometry.shadows": {"light": {"shadows": False}},
    "photometry.robust": {"factorize": {"loss": "squares"}},
    "extract.expected_error": {"extract": {"max_expected_error": math.inf}},
    "extract.pieces": {"extract": {"min_piece": 0.0}},
}


@dataclass
class Heard:
    """A listener of removals: entries, positions of removed elements, and masks of pixels."""

    entries: list[tuple[Removal, Tensor | None, Tensor | None]] = field(default_factory=list)

    def __call__(self, event: Event, outside: Emit) -> bool:
        """Keep an entry with a sample of its positions."""
        if not isinstance(event, RemovedElements):
            return outside(event)
        entry, mask, places = event.removal, event.mask, event.places()
        if mask is not None and places is not None and entry.count:
            taken = places.detach()[mask.flatten()]
            places = taken[:: math.ceil(len(taken) / SAMPLES)].double().cpu()
        pixels = mask.cpu() if mask is not None and mask.ndim == 3 and entry.count else None
        self.entries.append((entry, places if entry.count else None, pixels))
        return True


@dataclass(frozen=True)
class Judge:
    """The truth about removed elements; without a true scene, positions cannot be judged."""

    names: tuple[str, ...]
    spoilt: list[str]
    good: bool | None = None
    truth_from_world: Tensor | None = None
    surface: NearestSurface | None = None
    near: float = 0.0
    shown: Tensor | None = None

    def right(self, entry: Removal, places: Tensor | None, pixels: Tensor | None) -> float | None:
        """Return the fraction of removed elements that were valid; ``None`` if it is unknown."""
        if entry.what == "photographs" and entry.names:
            return sum(name not in self.spoilt for name in entry.names) / len(entry.names)
        if entry.what == "warning" and self.good is not None:
            return float(self.good)
        if places is not None and self.surface is not None and self.truth_from_world is not None:
            distance = self.surface.query(transform(self.truth_from_world, places)).distance
            return float((distance < self.near).double().mean())
        if pixels is not None and self.shown is not None and len(pixels) == len(self.shown):
            shown = interpolate(self.shown[:, None].float(), pixels.shape[1:])[:, 0] > 0.5
            return float(shown[pixels].double().mean())
        return None


def judge_of(
    place: Path, spoilt: list[str], result: Reconstruction | None
) -> tuple[Judge, dict[str, object]]:
    """Compare a result with the truth, and return the figures of cameras and surface, too."""
    if result is None or not (place / "truth").exists():
        names = () if result is None else result.scene.views.names
        return Judge(names=names, spoilt=spoilt), {}
    capture, names = read_rendered(place, maps=False, photographs=False), result.scene.views.names
    estimate = Estimate(mesh=result.mesh, names=names, cameras=result.cameras)
    generator = torch.Generator().manual_seed(0)
    moved = align_estimate(estimate, capture, "cameras", generator=generator).truth_from_world
    own = transfer(result.mesh, moved)
    surface = TrueSurface(capture).compare(own)
    middle = compare_along_rays(own, capture, len(capture.views.names) // 2)
    ends = [one.figures for one in result.report if one.name == "explain" and one.figures]
    cameras, mesh = camera_figures(estimate, capture), true_surface(capture)
    assert cameras is not None
    good = cameras.mean_rotation_deg < MOST_DEG and cameras.mean_center_percent < MOST_PERCENT
    judge = Judge(
        names=names,
        spoilt=spoilt,
        good=good,
        truth_from_world=moved,
        surface=NearestSurface(mesh),
        near=NEAR * surface.diagonal,
        shown=shown_by(place, capture, names),
    )
    return judge, {
        "rotation_deg": cameras.mean_rotation_deg,
        "centre_percent": cameras.mean_center_percent,
        "chamfer_percent": surface.seen.chamfer_mean_percent if surface.seen else None,
        "accuracy_percent": surface.accuracy.mean_percent if surface.accuracy else None,
        "covered_percent": 100 * middle.coverage if middle else None,
        "normals_deg": middle.shape_normals.mean_deg if middle and middle.shape_normals else None,
        "sticking_out_percent": 100 * ends[-1]["sticking_out"] if ends else None,
    }


def shown_by(place: Path, capture: Capture, names: tuple[str, ...]) -> Tensor | None:
    """Read which pixels of the registered photographs show the object."""
    masks = load_views(place / "photos", masks=place / "masks").masks
    rows = [capture.views.names.index(name) for name in names]
    return None if masks is None else masks[rows]


def run(place: Path, spoilt: list[str], preset: str, without: str) -> dict[str, Any]:
    """Reconstruct a set once; count the removals of every guard, and those of valid elements."""
    heard, result, failure = Heard(), None, ""
    chain = load_chain(preset, CHANGES.get(without, {}))
    began = time.perf_counter()
    with ExitStack() as stack:
        for target, replacement in PATCHES.get(without, {}).items():
            stack.enter_context(patch(f"pimper_torch.{target}", replacement))
        stack.enter_context(listening(heard))
        try:
            result = chain(load_views(place / "photos"))
        except (PimperError, RuntimeError, IndexError, ValueError) as error:  # without a guard
            failure = f"{type(error).__name__}: {str(error)[:200]}"
    seconds = time.perf_counter() - began
    judge, figures = judge_of(place, spoilt, result)
    rows: dict[str, dict[str, float]] = {}
    for entry, places, pixels in heard.entries:
        row = rows.setdefault(entry.guard, dict.fromkeys(("count", "total", "judged", "right"), 0))
        fraction = judge.right(entry, places, pixels) if entry.count else None
        row["count"], row["total"] = row["count"] + entry.count, row["total"] + entry.total
        if fraction is not None:
            row["judged"] += entry.count
            row["right"] += fraction * entry.count
    registered = [len(judge.names), len(list((place / "photos").iterdir()))]
    return {
        "seconds": seconds,
        "failure": failure,
        "registered": registered,
        **figures,
        "guards": rows,
    }


def told(found: dict[str, Any]) -> str:
    """Return the figures of a run as cells."""
    cells = [f"{found['registered'][0]} of {found['registered'][1]}"]
    for name in FIGURES:
        value = found.get(name)
        cells.append("" if value is None else f"{value:.3f}")
    return " | ".join([*cells, found["failure"].replace("|", "/")[:80], f"{found['seconds']:.0f}"])


def table(found: dict[tuple[str, str, str], dict[str, Any]]) -> Iterator[str]:
    """Format runs by set, removals on plain sets, and gains on the sets of each guard."""
    head = "views | ° | centres % | accuracy % | Chamfer % | covered % | normals ° | sticks out %"
    head += " | error | s | taken by its guards"
    yield f"\n| set | preset | without | {head} |"
    yield "|---|---|---|--:|--:|--:|--:|--:|--:|--:|--:|---|--:|---|"
    for (name, preset, without), each in sorted(found.items()):
        own = {guard: each["guards"].get(guard) for guard in SETS[name].guards}
        taken = [f"{guard} {row['count']} of {row['total']}" for guard, row in own.items() if row]
        yield f"| {name} | {preset} | {without} | {told(each)} | {', '.join(taken)} |"
    yield "\n| guard | what | preset | plain sets | took | of | % | right % | most on |"
    yield "|---|---|---|--:|--:|--:|--:|--:|---|"
    for guard, (what, _) in GUARDS.items():
        for preset in sorted({key[1] for key in found}):
            rows = {
                name: each["guards"][guard]
                for (name, used, without), each in found.items()
                if used == preset and not (without or SETS[name].guards) and guard in each["guards"]
            }
            sums = sum((Counter(row) for row in rows.values()), Counter())
            acted = [name for name, row in rows.items() if row["count"]]
            if not rows:
                continue
            part = f"{100 * sums['count'] / sums['total']:.2f}" if sums["total"] else ""
            right = f"{100 * sums['right'] / sums['judged']:.0f}" if sums["judged"] else ""
            most = max(
                acted, key=lambda name: rows[name]["count"] / rows[name]["total"], default=""
            )
            yield (
                f"| {guard} | {what} | {preset} | {len(acted)} of {len(rows)} | "
                f"{sums['count']:.0f} | {sums['total']:.0f} | {part} | {right} | {most} |"
            )


def main() -> None:
    """Read the command line, run the remaining sets, and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="of rendered scenes and results")
    parser.add_argument("--sets", nargs="+", choices=SETS, default=list(SETS), metavar="NAME")
    parser.add_argument("--presets", nargs="+", default=["fast", "default"])
    parser.add_argument("--without", choices=sorted({*PATCHES, *CHANGES}), help="on every set")
    parser.add_argument("--key", help="of the results; the commit by default")
    parser.add_argument("--tiny", action="store_true", help="8 photographs of 240x180 each")
    parser.add_argument("--table", action="store_true", help="print existing results, run nothing")
    options = parser.parse_args()
    commit = ("git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD")
    key = options.key or subprocess.run(commit, capture_output=True, text=True).stdout.strip()
    results = options.folder / "results" / (f"{key}-tiny" if options.tiny else key)
    results.mkdir(parents=True, exist_ok=True)
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    for preset in options.presets:
        for name in options.sets:
            own = [guard for guard in SETS[name].guards if guard in PATCHES or guard in CHANGES]
            for without in [options.without] if options.without else ["", *own]:
                whole = found.get((name, preset, ""))
                if without and whole and not whole["guards"].get(without, {}).get("count"):
                    continue  # it took nothing that it could be without
                path = results / f"{name}--{preset}--{without or 'all'}.json"
                if not path.exists() and not options.table:
                    place, spoilt = prepared(options.folder, name, options.tiny)
                    each = run(place, spoilt, preset, without)
                    path.with_suffix(".part").write_text(json.dumps(each))
                    path.with_suffix(".part").rename(path)
                    say(f"{name} {preset} {without}: {told(each)}")
                if path.exists():
                    found[name, preset, without] = json.loads(path.read_text())
    for line in table(found):
        say(line)


def say(line: str) -> None:
    """Write a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
