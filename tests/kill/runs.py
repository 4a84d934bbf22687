"""Kill runs at random moments; check that no result is lost and that each resumes to the same bits.

    python tests/kill/runs.py 50 0

for 50 runs of seed 0. A run ends by SIGKILL, by a limit on file sizes (as on a full disk), or by
too little memory; half of them write to a new folder, half to one with a former result. Then the
former or the new result must be complete; the same command, repeated, must give the files of an
uninterrupted run, byte for byte; and no other file may remain.

Runs are forked from a process with everything loaded; they take a second or two.
"""

import hashlib
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"  # a forking process must have one thread

# Files with times, which differ between runs.
TIMED = ("summary.json", "overview.png", "report.html", ".pimper.json")
SETTINGS = ("--preset", "fast")
FORMER = (*SETTINGS, "--faces", "all", "--factorize.light-prior", "3")
LONGEST = 300.0  # seconds, after which a run counts as hanging


def main(folder: Path, count: int, seed: int) -> None:
    """Run once without interruption, then end runs at random moments; print a line for each."""
    import pycolmap  # noqa: F401

    import pimper_bench.cli.render_command  # noqa: F401
    from pimper_torch.kernels.compile import GRADIENTS, ROWS, load

    load([name for row in ROWS for name in row if row != GRADIENTS])
    scene, moments = folder / "scene", random.Random(seed)
    small = "--num-views 6 --width 64 --height 48 --processes 1 --supersample 1 --seed 1"
    assert forked(["render", "balls", "-o", str(scene), *small.split()]) == 0
    command = ["reconstruct", str(scene / "photos"), "--sparse", str(scene / "truth" / "sparse")]
    # An asset has the name of its result's folder.
    whole, former = folder / "whole" / "out", folder / "former" / "out"
    assert forked([*command, "-o", str(former), *FORMER]) == 0
    forked([*command, "-o", str(folder / "first" / "out"), *SETTINGS])  # loads modules once
    began = time.perf_counter()
    assert forked([*command, "-o", str(whole), *SETTINGS]) == 0
    seconds = time.perf_counter() - began
    for number in range(count):
        ending = ("killed", "disk", "memory")[number % 3]
        over_former, moment = moments.random() < 0.5, moments.random()
        out = folder / f"run{number}" / "out"
        out.parent.mkdir()
        if over_former:
            shutil.copytree(former, out, ignore=shutil.ignore_patterns(".stages"))
        line = [*command, "-o", str(out), *SETTINGS]
        code = forked([*line, *["--overwrite"] * over_former], ending, moment, seconds)
        where = "over a former result" if over_former else "into a new folder"
        print(f"{number:3} {ending:7} at {moment:.2f} {where:20} exit {code:4}", flush=True)
        found = hashes(out)
        if not found:
            assert not over_former, "the former result is gone"
        elif ".pimper.json" in found or not (out / ".stages" / "new" / ".pimper.json").exists():
            assert found in (hashes(whole), hashes(former) if over_former else None)
        # Otherwise it is partly moved: the next run completes it.
        assert forked([*line, "--overwrite"]) == 0
        assert hashes(out) == hashes(whole)
        assert [path.name for path in out.parent.iterdir()] == ["out"]


def forked(line: list[str], ending: str = "", moment: float = 1.0, seconds: float = LONGEST) -> int:
    """Run a command in a forked process; return its exit code, or minus the signal's number."""
    from pimper_torch.cli.main import main as pimper

    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        quiet = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(quiet, stream)
        code = 70
        try:
            if ending == "memory":  # limits the stages' memory beyond that of the parent
                pages = int(Path("/proc/self/statm").read_text().split()[0])
                most = pages * resource.getpagesize() + int(moment * 400e6)
                resource.setrlimit(resource.RLIMIT_AS, (most, most))
            elif ending == "disk":
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (int(moment * 1e6),) * 2)
            code = pimper(line)
        finally:
            os._exit(code)
    end = time.monotonic() + (moment * seconds if ending == "killed" else LONGEST)
    while time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    assert ending == "killed", "it hangs"
    return -signal.SIGKILL


def hashes(folder: Path) -> dict[str, str]:
    """Hash every file of a result; for files with times only check existence."""
    return {
        name: "" if name in TIMED else hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
        if not (name := path.relative_to(folder).as_posix()).startswith(".stages/")
    }


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="pimper-kill-") as place:
        main(Path(place), *map(int, sys.argv[1:]))
