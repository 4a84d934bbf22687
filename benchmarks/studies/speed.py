"""Measure the time and memory of a run, stage by stage.

Run as ``python benchmarks/studies/speed.py TARGET [options of pimper reconstruct]``. TARGET is
``demo``, a rendered scene's name (it is rendered first, to ``--renderings``), or a folder: of
photographs, or as ``pimper render`` writes it. Prints a Markdown table: the stages summed over
passes, or one by one with ``--scales``. ``busy cores`` is CPU seconds over seconds and cores; other
programs lower it. ``of floor`` is the ratio to a lower bound on the time, measured in the same run:

- ``warp``, ``sweep``: one pass over all sampled radiance at the speed of copying memory.
- ``factorize``: one Gauss-Newton pass over it at the speed of batched products.
- ``photometry``: these three, which run bucket by bucket; each on one thread.
- ``fuse``: one multigrid cycle on the finest system of each pass.
- ``reconstruct``, with ``--colmap``: structure from motion with COLMAP's own settings.

``import`` is the time before the chain, ``aside`` the chain's time outside stages: hashes, records
kept for the next run, and the rest. The share of wall time in no row is printed below.

``-o FILE`` writes the figures as JSON; ``--against FILE`` prints ratios to those of an earlier run.
``--scaling`` runs photographs at 0.5, 0.71 and 1 times their size, each in a separate process, and
prints the exponents of time and memory in the number of samples.
"""

import argparse
import json
import math
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.table.measure import peak_memory, this_machine
from pimper_torch.cli.options import Job, parse
from pimper_torch.export.result_folder.folders import held_output
from pimper_torch.export.result_folder.marker import STAGES
from pimper_torch.export.results import write_result
from pimper_torch.io.photographs import load_views
from pimper_torch.presets.load_chain import make_chain
from pimper_torch.records import StageReport, Views
from pimper_torch.runtime.cores import usable_cores
from pimper_torch.runtime.reporting import ASIDE

SCENES = ("mug", "jar", "balls", "potatoes", "pair")
SIZES = (0.5, math.sqrt(0.5), 1.0)  # of photographs: 1, 2 and 4 times the samples
COLUMNS = ("seconds", "CPU s", "busy cores", "page faults", "peak MB", "of floor")

# Float32 red, green and blue of a sample in a view, and whether it is there.
_ENTRY_BYTES = 13
# Of a sample in a view: its prediction from 4 numbers, and its share in the 10 + 4 numbers of two
# systems of normal equations, of the sample's normal and of the view's light.
_ENTRY_FLOPS = 2 * (4 + 2 * 14)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """The cost of one or several stages.

    Attributes:
        stage: Its name.
        seconds: Wall clock.
        cpu_seconds: Of all threads.
        page_faults: Minor: pages that the kernel had to provide.
        peak_mb: Peak resident memory; NaN if the system does not report it.
        floor_seconds: Lower bound of the time; NaN if there is none.
    """

    stage: str
    seconds: float
    cpu_seconds: float
    page_faults: int
    peak_mb: float = math.nan
    floor_seconds: float = math.nan

    def __sub__(self, earlier: "Cost") -> "Cost":
        """Return the cost since an earlier reading of the clocks."""
        return replace(
            self,
            seconds=self.seconds - earlier.seconds,
            cpu_seconds=self.cpu_seconds - earlier.cpu_seconds,
            page_faults=self.page_faults - earlier.page_faults,
        )

    def cells(self, cores: int) -> list[str]:
        """Return the columns of the table."""
        return [
            f"{self.seconds:.1f}",
            f"{self.cpu_seconds:.1f}",
            f"{self.cpu_seconds / max(self.seconds, 1e-9) / cores:.0%}",
            f"{self.page_faults:,}",
            number(self.peak_mb),
            number(self.seconds / self.floor_seconds if self.floor_seconds else math.nan),
        ]


@dataclass
class Meter:
    """An observer of a run that reads the clocks whenever a stage begins or ends.

    Attributes:
        costs: Of the stages in the order they ended.
        figures: The figures of each stage's report.
        cycles: Seconds of multigrid cycles since the stage began, by the size of their system.
    """

    costs: list[Cost] = field(default_factory=list)
    figures: list[Mapping[str, float]] = field(default_factory=list)
    cycles: dict[int, list[float]] = field(default_factory=dict)
    _open: dict[str, Cost] = field(default_factory=dict)
    _peak: Callable[[], float | None] = lambda: None
    _stack: ExitStack = field(default_factory=ExitStack)

    def started(self, stage: str) -> None:
        """Hear that a stage begins; others may be under way."""
        self._remember_peak()
        self._peak = self._stack.enter_context(peak_memory())
        self._open[stage] = clocks(stage)
        self.cycles.clear()

    def progressed(self, done: int, total: int) -> None:
        """Hear of batches, which are not counted."""

    def finished(self, report: StageReport) -> None:
        """Hear that a stage ended."""
        self.ended(report.name, report.figures)

    def ended(self, stage: str, figures: Mapping[str, float] | None = None) -> None:
        """Record the cost of a stage."""
        self._remember_peak()
        began = self._open.pop(stage)
        cost = replace(clocks(stage) - began, peak_mb=began.peak_mb)
        if stage == "fuse" and self.cycles:
            cost = replace(cost, floor_seconds=statistics.median(self.cycles[max(self.cycles)]))
        self.costs.append(cost)
        self.figures.append(figures or {})

    def _remember_peak(self) -> None:
        peak = self._peak()
        if peak is not None:
            for stage, began in self._open.items():
                highest = peak if math.isnan(began.peak_mb) else max(peak, began.peak_mb)
                self._open[stage] = replace(began, peak_mb=highest)


def clocks(stage: str) -> Cost:
    """Read the clocks: the cost of the process so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return Cost(
        stage=stage,
        seconds=time.perf_counter(),
        cpu_seconds=usage.ru_utime + usage.ru_stime,
        page_faults=usage.ru_minflt,
    )


def added(stage: str, costs: Sequence[Cost]) -> Cost:
    """Add up the costs of consecutive stages.

    A round without a floor, as of a fusion so small that it is solved directly, is taken to be as
    far from it as the others.
    """
    seconds = sum(cost.seconds for cost in costs)
    known = [cost for cost in costs if not math.isnan(cost.floor_seconds)]
    fraction = sum(cost.seconds for cost in known) / seconds if seconds else 0
    floor = sum(cost.floor_seconds for cost in known) / fraction if fraction else math.nan
    return Cost(
        stage=stage,
        seconds=seconds,
        cpu_seconds=sum(cost.cpu_seconds for cost in costs),
        page_faults=sum(cost.page_faults for cost in costs),
        peak_mb=max((cost.peak_mb for cost in costs), default=math.nan),
        floor_seconds=floor,
    )


def by_stage(costs: Sequence[Cost]) -> list[Cost]:
    """Add up the rounds."""
    names = dict.fromkeys(cost.stage for cost in costs)
    return [added(name, [cost for cost in costs if cost.stage == name]) for name in names]


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line, run, print tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("target", help="demo, a scene's name or a folder")
    parser.add_argument("-o", "--out", type=Path, help="JSON file for the figures")
    parser.add_argument("--against", type=Path, help="JSON file of an earlier run")
    parser.add_argument("--scales", action="store_true", help="one row a scale")
    parser.add_argument("--scaling", action="store_true", help="at three sizes")
    parser.add_argument("--colmap", action="store_true", help="COLMAP's own settings, too")
    parser.add_argument("--renderings", type=Path, default=Path("renderings"))
    options, others = parser.parse_known_args(arguments)
    imports = replace(clocks("import"), seconds=since_start())
    target = photographs(options.target, options.renderings)
    if options.scaling:
        print_scaling(scaled_runs(target, others))
        return
    with tempfile.TemporaryDirectory() as folder:
        job = job_of(target, others, Path(folder) / "result")
        found = measured(job, imports, options.colmap)
    print_table(found, options.scales)
    if options.against:
        print_ratios(found, json.loads(options.against.read_text(encoding="utf-8")))
    if options.out:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def photographs(target: str, renderings: Path) -> str:
    """Return the folder of the photographs, rendered if need be, or ``demo``."""
    if target in SCENES and not Path(target).is_dir():
        folder = renderings / target
        if not folder.is_dir():
            render_scene(target, folder, SceneConfig(), processes=usable_cores())
        target = str(folder)
    return str(Path(target) / "photos") if (Path(target) / "photos").is_dir() else target


def job_of(target: str, others: Sequence[str], out: Path) -> Job:
    """Read the options as ``pimper`` does."""
    if target == "demo":
        return parse("demo", ["-o", str(out), *others])
    return parse("reconstruct", [target, "-o", str(out), *others])


def since_start() -> float:
    """Return the seconds since this process started; NaN if the system does not report it."""
    try:
        fields = Path("/proc/self/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:
        return math.nan
    started = int(fields[19]) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - started


def measured(job: Job, imports: Cost, colmap: bool) -> dict[str, Any]:
    """Run once and give all figures."""
    meter, began = Meter(costs=[imports], figures=[{}]), clocks("all")
    watch_cycles(meter)
    with held_output(job.out, "result"):
        meter.started("read")
        views = load_views(
            job.photos,
            masks=job.inputs.masks,
            mask_object=job.inputs.mask_object,
            encoding=job.config.photographs,
            max_size_px=job.common.max_size_px or 0,
        ).to(job.common.device)
        meter.ended("read")
        chain = make_chain(job.config, meter, job.common.cache or job.out / STAGES)
        before, entered = len(meter.costs), clocks("aside")
        result = chain(views, job.inputs.sparse)
        meter.costs.append(clocks("aside") - entered - added("stages", meter.costs[before:]))
        meter.figures.append({})
        meter.started("write")
        write_result(result, job.config, job.out, about={})
        meter.ended("write")
        clock_seconds = imports.seconds + (clocks("all") - began).seconds
    files = (path for path in job.out.rglob("*") if path.is_file() and STAGES not in path.parts)
    written = sum(path.stat().st_size for path in files)
    floors = {
        "copy_gb_per_s": copy_bytes_per_s() / 1e9,
        "batched_product_gflop_per_s": product_flops_per_s() / 1e9,
        "colmap_seconds": colmap_seconds(views) if colmap else math.nan,
    }
    entries = [
        figures["template_samples"] * result.scene.views.num_views
        for figures in meter.figures
        if "template_samples" in figures
    ]
    return {
        "photographs": str(job.photos),
        "size_px": views.sizes_px.amax(dim=0).tolist(),
        "num_views": views.num_views,
        "preset": job.common.preset,
        "machine": asdict(this_machine()),
        "floors": floors,
        "entries": entries,
        "patches": [figures["patches"] for figures in meter.figures if "patches" in figures],
        "vertices": len(result.mesh.vertices_world),
        "written_mb": written / 1e6,
        "clock_seconds": clock_seconds,
        "aside": {one.name: one.seconds for one in result.report if one.name in ASIDE},
        "costs": [asdict(cost) for cost in with_floors(meter.costs, floors, entries)],
    }


def with_floors(
    costs: Sequence[Cost], floors: Mapping[str, float], entries: Sequence[float]
) -> list[Cost]:
    """Add lower bounds to the costs of stages.

    Args:
        costs: Of the stages as they ran.
        floors: As :func:`measured` gives them.
        entries: Samples in views, a round each.
    """
    a_pass = _ENTRY_BYTES / (floors["copy_gb_per_s"] * 1e9)
    a_step = _ENTRY_FLOPS / (floors["batched_product_gflop_per_s"] * 1e9)
    an_entry = {"warp": a_pass, "factorize": a_step, "sweep": a_pass}
    an_entry["photometry"] = sum(an_entry.values())
    found, iterations = [], dict.fromkeys(an_entry, 0)
    for cost in costs:
        if cost.stage in an_entry and iterations[cost.stage] < len(entries):
            least = an_entry[cost.stage] * entries[iterations[cost.stage]]
            iterations[cost.stage] += 1
            found.append(replace(cost, floor_seconds=least))
        elif cost.stage == "reconstruct":
            found.append(replace(cost, floor_seconds=floors["colmap_seconds"]))
        else:
            found.append(cost)
    return found


def watch_cycles(meter: Meter) -> None:
    """Time every multigrid cycle; other solvers have no lower bound."""
    try:
        from pimper_torch.linalg.hierarchy import Hierarchy

        cycle: Callable[..., Any] = Hierarchy.cycle
    except (ImportError, AttributeError):
        return

    def timed(self: Hierarchy, residual: torch.Tensor) -> torch.Tensor:
        began = time.perf_counter()
        found = cycle(self, residual)
        meter.cycles.setdefault(len(residual), []).append(time.perf_counter() - began)
        return found

    Hierarchy.cycle = timed


def copy_bytes_per_s(size: int = 2**26) -> float:
    """Measure the speed of copying memory; bytes read and bytes written both count."""
    source, target = torch.ones(size), torch.zeros(size)
    return 2 * source.nbytes / quickest(lambda: target.copy_(source))


def product_flops_per_s(batch: int = 600, samples: int = 235, views: int = 24) -> float:
    """Measure batched products of the shapes of normal equations: 14 numbers a sample."""
    weights, squares = torch.rand(batch, samples, views), torch.rand(batch, views, 14)
    return 2 * batch * samples * views * 14 / quickest(lambda: weights @ squares)


def quickest(work: Callable[[], object], times: int = 5) -> float:
    """Return the seconds of the quickest of a few runs."""
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        work()
        taken.append(time.perf_counter() - began)
    return min(taken)


def colmap_seconds(views: Views) -> float:
    """Run structure from motion with COLMAP's own settings."""
    from sfm import COLMAP  # the script in this folder

    from pimper_torch.stages.sfm.reconstruct import Reconstruct

    began = time.perf_counter()
    Reconstruct(COLMAP)(views)
    return time.perf_counter() - began


def scaled_runs(target: str, others: Sequence[str]) -> list[dict[str, Any]]:
    """Measure at three sizes of the photographs, each in a process of its own."""
    job = job_of(target, others, Path("unused"))
    longest = max(
        max(Image.open(path).size)
        for path in Path(job.photos).iterdir()
        if path.suffix.lower() in Image.registered_extensions()
    )
    longest = min(longest, job.common.max_size_px or longest)
    found = []
    for size in SIZES:
        pixels = str(round(size * longest))
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "figures.json"
            command = [sys.executable, __file__, target, "-o", str(out), *others]
            subprocess.run([*command, "--max-size-px", pixels], check=True, stdout=sys.stderr)
            found.append(json.loads(out.read_text(encoding="utf-8")))
    return found


def costs_of(found: Mapping[str, Any]) -> list[Cost]:
    """Read the costs out of figures."""
    return [Cost(**cost) for cost in found["costs"]]


def cost_rows(found: Mapping[str, Any], scales: bool = False) -> list[Cost]:
    """Return the stages, all of them, and all after structure from motion."""
    costs = costs_of(found)
    names = [cost.stage for cost in costs]
    after = costs[names.index("reconstruct") + 1 :] if "reconstruct" in names else costs
    return [
        *(costs if scales else by_stage(costs)),
        replace(added("after structure from motion", after), floor_seconds=math.nan),
        replace(added("all", costs), floor_seconds=math.nan),
    ]


def print_table(found: Mapping[str, Any], scales: bool) -> None:
    """Print the cost of a run."""
    cores, floors = found["machine"]["cores"], found["floors"]
    width, height = found["size_px"]
    say(
        f"\n{found['num_views']} photographs of {width}x{height}, {found['preset']}: "
        f"{found['vertices']:,} vertices, {found['written_mb']:.0f} MB written. Patches a round: "
        f"{', '.join(f'{count:,.0f}' for count in found['patches'])}; samples in views: "
        f"{', '.join(f'{count:,.0f}' for count in found['entries'])}. "
        f"{found['machine']['cpu']}, {cores} cores; copies {floors['copy_gb_per_s']:.1f} GB/s, "
        f"batched products {floors['batched_product_gflop_per_s']:.1f} GFLOP/s.\n"
    )
    rows = cost_rows(found, scales)
    table(("stage", *COLUMNS), [[row.stage, *row.cells(cores)] for row in rows])
    left = found["clock_seconds"] - rows[-1].seconds
    aside = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in found["aside"].items())
    say(
        f"\nAside: {aside}. {left:.1f} s of {found['clock_seconds']:.1f} s are in no line: "
        f"{left / found['clock_seconds']:.1%}."
    )


def print_ratios(found: Mapping[str, Any], earlier: Mapping[str, Any]) -> None:
    """Print each stage's figures over those of an earlier run."""
    before = {row.stage: row for row in cost_rows(earlier)}
    names = ("seconds", "cpu_seconds", "page_faults", "peak_mb")
    rows = []
    for row in cost_rows(found):
        was = before.get(row.stage)
        pairs = [(getattr(row, name), getattr(was, name)) for name in names] if was else []
        rows.append([row.stage, *(number(now / old if old else math.nan) for now, old in pairs)])
    say("\nOver the earlier run's:\n")
    table(("stage", *COLUMNS[:2], *COLUMNS[3:5]), rows)


def print_scaling(runs: Sequence[Mapping[str, Any]]) -> None:
    """Print how costs grow: the exponent of each in the samples, 1 where it is linear."""
    samples = [sum(run["entries"]) for run in runs]
    patches = [max(run["patches"], default=0) for run in runs]
    cores = runs[0]["machine"]["cores"]
    say(f"\nSamples in views: {', '.join(f'{count:,.0f}' for count in samples)}; most patches: ")
    say(f"{', '.join(f'{count:,.0f}' for count in patches)}; {cores} cores.\n")
    tables = [{row.stage: row for row in cost_rows(run)} for run in runs]
    rows = []
    for stage in tables[-1]:
        row = [rows_of_run[stage] for rows_of_run in tables if stage in rows_of_run]
        if len(row) < len(runs):
            continue
        seconds, peaks = [cost.cpu_seconds for cost in row], [cost.peak_mb for cost in row]
        rows.append(
            [
                stage,
                " / ".join(f"{value:.1f}" for value in seconds),
                number(exponent(samples, seconds)),
                " / ".join(map(number, peaks)),
                number(exponent(samples, peaks)),
                number(exponent(patches, peaks)),
            ]
        )
    heads = ("CPU s", "exponent in samples", "peak MB", "exponent in samples", "in patches")
    table(("stage", *heads), rows)


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Fit ``cost = c * size ** exponent`` by least squares of logarithms; NaN where none fits."""
    if min(*sizes, *costs) <= 0 or len(set(sizes)) < 2 or any(map(math.isnan, costs)):
        return math.nan
    across, up = [math.log(size) for size in sizes], [math.log(cost) for cost in costs]
    return statistics.linear_regression(across, up).slope


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a Markdown table."""
    say("| " + " | ".join(heads) + " |")
    say("|---|" + "--:|" * (len(heads) - 1))
    for row in rows:
        say("| " + " | ".join([*row, *["-"] * (len(heads) - len(row))]) + " |")


def number(value: float) -> str:
    """Write three digits, or a dash for an unknown value."""
    if math.isnan(value):
        return "-"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def say(line: str) -> None:
    """Write a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
