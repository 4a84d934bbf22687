"""Measure how time and memory grow with the number of photographs and with their size.

Run as ``python benchmarks/growth.py FOLDER... [--num-views 10 20 30] [--max-size-px 800 1600]``.
Each folder contains photographs, or a rendered scene. Runs ``pimper reconstruct`` on each number of
them, evenly spaced, scaled to each size, one run after another. Prints a Markdown table: facets,
vertices before simplification, seconds, CPU seconds and GB of the process, and the seconds and GB
that ``pimper doctor`` estimates. Options after ``--`` are passed to ``pimper reconstruct``.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from pimper_torch.cli.doctor.cost import estimate
from pimper_torch.io.photograph_files import list_images

HEADER = "photographs | size | facets | vertices | CPU s | s | estimated | GB | estimated"


def main() -> None:
    """Print a row for each run."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("folders", type=Path, nargs="+")
    options.add_argument("--num-views", type=int, nargs="+", default=[10, 20, 30])
    options.add_argument("--max-size-px", type=int, nargs="+", default=[800, 1600])
    arguments = sys.argv[1:]
    end = arguments.index("--") if "--" in arguments else len(arguments)
    given = options.parse_args(arguments[:end])
    tell(f"| set | {HEADER} |\n|---|--:|---|" + "--:|" * 7)
    for folder in given.folders:
        photos = folder / "photos"
        photographs = list_images(photos if photos.exists() else folder)
        for longest in given.max_size_px:
            for count in given.num_views:
                if count <= len(photographs):
                    tell(measured(folder.name, photographs, count, longest, arguments[end + 1 :]))


def measured(
    name: str, photographs: Sequence[Path], count: int, longest: int, more: Sequence[str]
) -> str:
    """Reconstruct from some photographs and return the row."""
    chosen = [photographs[at * len(photographs) // count] for at in range(count)]
    with Image.open(chosen[0]) as image:
        wide, high = image.size
    scale = min(1.0, longest / max(wide, high))
    size = f"{round(scale * wide)}x{round(scale * high)}"
    seconds, memory = estimate(count * scale**2 * wide * high / 1e6, count)
    with tempfile.TemporaryDirectory() as folder:
        photos, out = Path(folder) / "photos", Path(folder) / "out"
        photos.mkdir()
        for path in chosen:
            (photos / path.name).symlink_to(path.resolve())
        command = ["pimper", "reconstruct", str(photos), "-o", str(out), "--quiet", *more]
        began = time.monotonic()
        child = subprocess.Popen([*command, "--max-size-px", str(longest)])
        _, status, used = os.wait4(child.pid, 0)
        took = time.monotonic() - began
        if status:
            return f"| {name} | {count} | {size} | failed |" + " |" * 6
        found = json.loads((out / "summary.json").read_text())
    return (
        f"| {name} | {count} | {size} | {found['triangles']:,} | {found['vertices']:,} "
        f"| {used.ru_utime + used.ru_stime:.0f} | {took:.0f} | {seconds:.0f} "
        f"| {found['peak_memory_mb'] / 1024:.1f} | {memory:.1f} |"
    )


def tell(line: str) -> None:
    """Print a line."""
    print(line, flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
