"""Run the chain many times in one process, and tell what grows.

    python tests/soak/soak.py --runs 20
    python tests/soak/soak.py --runs 20 --demo

The first runs a small rendered scene, the second the skull of `pimper demo`, both by the command
line's own function. Memory is what the process holds after garbage was collected.
"""

import argparse
import gc
import os
import sys
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path

from pimper_torch.cli.main import main as pimper
from pimper_torch.runtime.memory import release_memory, resident_bytes

_SCENE = "--num-views 8 --width 240 --height 180 --processes 1 --supersample 1 -q"
# Of memory, after the first two runs, which load modules and kernels and fill pools.
MOST_GROWTH = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class Held:
    """What the process holds after a run."""

    megabytes: float
    threads: int
    handles: int
    temporary: int


def held() -> Held:
    """Look at this process and at its folder of temporary files."""
    gc.collect()
    release_memory()
    return Held(
        megabytes=resident_bytes() / 1e6,
        threads=len(list(Path("/proc/self/task").iterdir())),
        handles=len(list(Path("/proc/self/fd").iterdir())),
        temporary=len(list(Path(tempfile.gettempdir()).iterdir())),
    )


def soak(runs: int, command: list[str], folder: Path) -> list[Held]:
    """Run a command so many times, and look after each; its result is replaced every time."""
    found = []
    for run in range(runs):
        if pimper([*command, "-o", str(folder / "out"), "--overwrite", "--fresh", "-q"]) != 0:
            raise RuntimeError(f"run {run} failed")
        found.append(held())
        print(run, found[-1], f"{threading.active_count()} Python threads", flush=True)  # noqa: T201
    return found


def grown(found: list[Held]) -> list[str]:
    """Say what the last run holds more of than the second."""
    settled, last = found[1], found[-1]
    told = [
        f"{name}: {getattr(settled, name)} after two runs, {getattr(last, name)} at the end"
        for name in ("threads", "handles", "temporary")
        if getattr(last, name) > getattr(settled, name)
    ]
    growth = last.megabytes / settled.megabytes - 1
    if growth > MOST_GROWTH:
        told.append(f"memory grew by {growth:.1%}")
    return told


def small_scene(folder: Path) -> list[str]:
    """Render 8 photographs of 240x180, and give the command that reconstructs them."""
    scene = folder / "scene"
    if pimper(["render", "jar", "-o", str(scene), *_SCENE.split()]) != 0:
        raise RuntimeError("the scene was not rendered")
    return ["reconstruct", str(scene / "photos"), "--preset", "fast"]


def main() -> int:
    """Run, and exit with 1 where anything grew."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--demo", action="store_true", help="the skull, by the default preset")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(folder) / "tmp"
        inside.mkdir()
        tempfile.tempdir = os.environ["TMPDIR"] = str(inside)
        command = ["demo"] if options.demo else small_scene(Path(folder))
        told = grown(soak(options.runs, command, Path(folder)))
        tempfile.tempdir = None
    sys.stdout.writelines(f"{line}\n" for line in told or ["nothing grew"])
    return int(bool(told))


if __name__ == "__main__":
    raise SystemExit(main())
