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
from pathlib import Path

from pimper_torch.cli.main import main as pimper
from pimper_torch.runtime.memory import release_memory, resident_bytes

_SCENE = "--num-views 8 --width 240 --height 180 --processes 1 --supersample 1 -q"
# Of memory, after the first two runs, which load modules and kernels and fill pools.
MOST_GROWTH = 0.03


def held() -> dict[str, float]:
    """Count what this process holds, and what its folder of temporary files does."""
    gc.collect()
    release_memory()
    return {
        "memory": resident_bytes() / 1e6,
        "threads": len(list(Path("/proc/self/task").iterdir())),
        "handles": len(list(Path("/proc/self/fd").iterdir())),
        "temporary files": len(list(Path(tempfile.gettempdir()).iterdir())),
    }


def soak(runs: int, command: list[str], folder: Path) -> list[dict[str, float]]:
    """Run a command so many times, and look after each; its result is replaced every time."""
    found = []
    for run in range(runs):
        if pimper([*command, "-o", str(folder / "out"), "--overwrite", "--fresh", "-q"]) != 0:
            raise RuntimeError(f"run {run} failed")
        found.append(held())
        print(run, found[-1], f"{threading.active_count()} Python threads", flush=True)  # noqa: T201
    return found


def grown(found: list[dict[str, float]]) -> list[str]:
    """Say what the last run holds more of than the second."""
    settled, last = found[1], found[-1]
    return [
        f"{name}: {settled[name]} after two runs, {last[name]} at the end"
        for name in settled
        if last[name] > settled[name] * (1 + MOST_GROWTH * (name == "memory"))
    ]


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
