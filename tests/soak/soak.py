"""Run the chain many times in one process, and check that its memory does not grow.

    python tests/soak/soak.py 20
    python tests/soak/soak.py 20 demo

for 20 runs of a small rendered scene, or of the skull of `pimper demo`, by the function of the
command line. Memory is measured after garbage collection.
"""

import gc
import os
import sys
import tempfile
from pathlib import Path

from pimper_torch.cli.main import main as pimper
from pimper_torch.runtime.memory import release_memory, resident_bytes

_SIZE = "--num-views 8 --width 240 --height 180 --processes 1 --supersample 1 -q"
# Growth of memory after the first two runs, which load modules and kernels and fill pools.
MOST_GROWTH = 0.03


def held() -> dict[str, float]:
    """Measure the resources of this process and of its folder of temporary files."""
    gc.collect()
    release_memory()
    return {
        "megabytes": resident_bytes() / 1e6,
        "threads": len(list(Path("/proc/self/task").iterdir())),
        "handles": len(list(Path("/proc/self/fd").iterdir())),
        "temporary files": len(list(Path(tempfile.gettempdir()).iterdir())),
    }


def soak(folder: Path, runs: int, command: list[str]) -> None:
    """Run a command ``runs`` times, and measure after each; its result is replaced every time."""
    tempfile.tempdir = os.environ["TMPDIR"] = str(folder / "tmp")
    (folder / "tmp").mkdir()
    if not command:
        scene = folder / "scene"
        render = ["render", "mug", "--table", "patterned", "-o", str(scene)]
        assert pimper([*render, *_SIZE.split()]) == 0
        command = ["reconstruct", str(scene / "photos"), "--preset", "fast"]
    found = []
    for run in range(runs):
        assert pimper([*command, "-o", str(folder / "out"), "--overwrite", "--fresh", "-q"]) == 0
        found.append(held())
        print(run, found[-1], flush=True)  # noqa: T201
    for name, settled in found[1].items():
        most = settled * (1 + MOST_GROWTH * (name == "megabytes"))
        assert found[-1][name] <= most, f"{name}: {settled} after two runs, {found[-1][name]} now"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        soak(Path(place), int(sys.argv[1]), sys.argv[2:])
        tempfile.tempdir = None
