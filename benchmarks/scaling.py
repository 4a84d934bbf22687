"""Print the time of many objects on many workers, and check the model on this machine.

Run as ``python benchmarks/scaling.py``. Prints a Markdown table of hours for 1, 10 and 100 workers
and 10^2 to 10^5 photographs, in objects of ``--num-views`` each. It assumes that

- a worker has 2 cores and processes one object at a time with ``default``, in the seconds that
  ``pimper doctor`` estimates from measured stages;
- ``pimper batch`` starts a process per run, and checks every object before the first begins;
- CPU seconds of an object do not depend on the number of concurrent runs, disks are fast enough,
  and no run fails.

``--check FOLDER`` renders eight small objects there, reconstructs them with 1, 2 and 4 processes of
one thread each, and prints CPU and wall seconds, the latter next to the model's prediction.
"""

import argparse
import math
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

from pimper_torch.cli.doctor.cost import estimate
from pimper_torch.runtime.cores import usable_cores

WORKERS = (1, 10, 100)
PHOTOGRAPHS = (100, 1_000, 10_000, 100_000)
# Seconds of one core: `pimper batch` of one object over `pimper reconstruct` (1.1, docs/decisions),
# and looking at an object of a table (0.06).
START_S, LOOK_S = 1.1, 0.06
OBJECTS, PROCESSES = 8, (1, 2, 4)
SMALL = "--num-views 6 --width 80 --height 60 --processes 1 --supersample 1 -q"
SETTINGS = ("--preset", "fast", "--no-report")


def main() -> None:
    """Print the model's table, or the check."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--num-views", type=int, default=30)
    options.add_argument("--width", type=int, default=1600)
    options.add_argument("--height", type=int, default=1200)
    options.add_argument("--check", type=Path)
    given = options.parse_args()
    if given.check is not None:
        check(given.check)
        return
    megapixels = given.num_views * given.width * given.height / 1e6
    seconds, _ = estimate(megapixels, given.num_views)
    tell(f"{seconds:.0f} s an object of {given.num_views} photographs, {megapixels:.1f} megapixels")
    tell("\n| photographs | objects |" + "".join(f" {count} workers |" for count in WORKERS))
    tell("|--:|--:|" + "--:|" * len(WORKERS))
    for photographs in PHOTOGRAPHS:
        objects = math.ceil(photographs / given.num_views)
        hours = (wall(objects, workers, seconds) / 3600 for workers in WORKERS)
        tell(f"| {photographs:,} | {objects:,} |" + "".join(f" {one:.1f} h |" for one in hours))


def wall(objects: int, workers: int, seconds: float) -> float:
    """Return the seconds that objects of some seconds each take on workers."""
    return objects * LOOK_S + math.ceil(objects / workers) * (seconds + START_S)


def check(folder: Path) -> None:
    """Reconstruct small objects with increasing numbers of processes, and print their times."""
    scene = folder / "scene"
    pimper("render", "jar", "-o", scene, *SMALL.split(), "--overwrite")
    rows = [f"object{number},scene/photos,scene/truth/sparse,scene/masks" for number in range(8)]
    (folder / "list.csv").write_text("\n".join(["name,photos,sparse,masks", *rows]) + "\n")
    tell("| processes | CPU s | wall s | model | load before |\n|--:|--:|--:|--:|--:|")
    alone = 0.0
    for jobs in PROCESSES:
        load = os.getloadavg()[0]
        before, began = used(), time.perf_counter()
        own = ("--jobs", jobs, "--cpus-per-task", 1, "-q", "--", *SETTINGS)
        pimper("batch", folder / "list.csv", "-o", folder / f"by_{jobs}", *own)
        took, cpu = time.perf_counter() - began, used() - before
        alone = alone or took
        shared = min(jobs, usable_cores())
        model = alone * math.ceil(OBJECTS / shared) / OBJECTS
        tell(f"| {jobs} | {cpu:.0f} | {took:.0f} | {model:.0f} | {load:.1f} |")


def tell(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def pimper(*words: object) -> None:
    """Run a command of the package."""
    subprocess.run([sys.executable, "-m", "pimper_torch", *map(str, words)], check=True)


def used() -> float:
    """Return the CPU seconds of all processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
