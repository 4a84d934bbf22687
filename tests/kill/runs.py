"""Kill runs at random moments, and see that nothing is lost and that each goes on to the same bits.

    python tests/kill/runs.py --count 50 --seed 0

A run is ended by SIGKILL, by files that may grow no further, as on a full disk, or by too little
memory, as often into a folder that is new as into one that holds a former result. Then: the former
result is whole, or the new one; the same command, undisturbed, ends with the files of a run that
never was disturbed, byte for byte; and no hidden folder is left beside it.

Runs are forked from a process that has everything loaded; they take a second or two.
"""

import argparse
import hashlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"  # a process that is forked must have one thread

ENDINGS = ("killed", "disk", "memory")
# What tells times, and so differs from run to run.
TIMED = ("summary.json", "overview.png", "report.html", ".pimper.json")
SETTINGS = ("--preset", "fast")
FORMER = (*SETTINGS, "--faces", "all", "--factorize.light-prior", "3")
# Seconds after which a run hangs, and what stands for its exit code.
LONGEST, HANGS = 300.0, 71


def main() -> int:
    """Print a line a run; 1 where one lost or changed something."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=50)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--endings", nargs="+", choices=ENDINGS, default=ENDINGS)
    given = options.parse_args()
    failed, random_moments = 0, random.Random(given.seed)
    with tempfile.TemporaryDirectory(prefix="pimper-kill-") as name:
        folder = Path(name)
        command, seconds = undisturbed(folder)
        for number in range(given.count):
            ending = given.endings[number % len(given.endings)]
            over_former, moment = random_moments.random() < 0.5, random_moments.random()
            home = folder / f"run{number}"
            home.mkdir()
            disturbed = disturbance(ending, moment, seconds)
            code, faults = ended(command, home, over_former, disturbed)
            where = "over a former result" if over_former else "into a new folder"
            said = f"{number:3} {ending:7} at {moment:5.2f} {where:20} exit {code:4}"
            print(f"{said}: {'; '.join(faults) or 'the same bits'}", flush=True)
            failed += bool(faults)
    print(f"{given.count} runs, {failed} of them lost or changed something")
    return int(failed > 0)


def undisturbed(folder: Path) -> tuple[list[str], float]:
    """Render a scene and run twice undisturbed; give the command and the seconds that it takes."""
    load()
    scene = folder / "scene"
    small = "--num-views 6 --width 64 --height 48 --processes 1 --supersample 1 --seed 1"
    assert forked(["render", "balls", "-o", str(scene), *small.split()]) == 0
    command = ["reconstruct", str(scene / "photos"), "--sparse", str(scene / "truth" / "sparse")]
    assert forked([*command, "-o", str(folder / "former"), *FORMER]) == 0
    forked([*command, "-o", str(folder / "first"), *SETTINGS])  # what is loaded once
    began = time.perf_counter()
    assert forked([*command, "-o", str(folder / "whole"), *SETTINGS]) == 0
    return command, time.perf_counter() - began


def ended(
    command: list[str], home: Path, over_former: bool, disturbed: "Disturbance"
) -> tuple[int, list[str]]:
    """End a run, and run again: the exit code of the first, and what was wrong after either."""
    whole, former, out = (*(home.with_name(name) for name in ("whole", "former")), home / "out")
    if over_former:
        copied(former, out)
    line = [*command, "-o", str(out), *SETTINGS]
    code = forked([*line, *(["--overwrite"] * over_former)], disturbed)
    faults = ["it hangs"] * (code == HANGS)
    faults += half_replaced(out, (whole, former) if over_former else (whole,))
    again = forked([*line, "--overwrite"])
    faults += [] if again == 0 else [f"the next run exits with {again}"]
    faults += [f"{name} differs" for name in unlike(out, whole)]
    hidden = sorted(path.name for path in home.iterdir() if path != out)
    return code, faults + ([f"left beside it: {', '.join(hidden)}"] if hidden else [])


def load() -> None:
    """Load what runs need, so that those that are forked have it."""
    import pycolmap  # noqa: F401

    import pimper_bench.cli.render_command  # noqa: F401
    from pimper_torch.ground.kernels.compile import compile_all

    compile_all()


Disturbance = tuple[Callable[[], None], float | None]


def disturbance(ending: str, moment: float, seconds: float) -> Disturbance:
    """Give what a run does before it begins, and the seconds after which it is killed."""
    if ending == "killed":
        return (lambda: None), moment * seconds
    if ending == "memory":  # of what the stages take on top of what is loaded
        return (lambda: limit_memory(int(moment * 400e6))), None
    return (lambda: limit_files(int(moment * 1e6))), None


def limit_memory(more: int) -> None:
    """Limit the address space to what is used, and some bytes more."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + more,) * 2)


def limit_files(size: int) -> None:
    """Refuse files that are larger, as a full disk does."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def forked(line: list[str], disturbed: Disturbance = ((lambda: None), None)) -> int:
    """Carry out a command in a process of its own; minus a signal's number where one ended it."""
    from pimper_torch.cli.main import main

    prepare, seconds = disturbed
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        quiet = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(quiet, stream)
        code = 70
        try:
            prepare()
            code = main(line)
        finally:
            os._exit(code)
    began, limit = time.monotonic(), LONGEST if seconds is None else seconds
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() - began > limit:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return -signal.SIGKILL if seconds is not None else HANGS
        time.sleep(0.01)


def copied(source: Path, target: Path) -> None:
    """Copy a result without what is kept for the next run."""
    subprocess.run(["cp", "-a", str(source), str(target)], check=True)
    subprocess.run(["rm", "-rf", str(target / ".stages")], check=True)


def half_replaced(out: Path, results: tuple[Path, ...]) -> Iterator[str]:
    """Tell what is wrong with a folder that should hold one of some results, or nothing new."""
    visible = [path for path in out.iterdir() if path.name != ".stages"] if out.exists() else []
    if not visible:
        if len(results) > 1:
            yield "the former result is gone"
        return
    if not (out / ".pimper.json").exists() and (out / ".stages/new/.pimper.json").exists():
        return  # on its way: the next run brings the rest
    if all(unlike(out, result) for result in results):
        yield "what is there is neither the former result nor the new one"
    names = json.loads((out / ".pimper.json").read_text())
    if not names:
        yield "its list is empty"


def unlike(out: Path, other: Path) -> list[str]:
    """Name the files that are not the same in two results, but for those that tell times."""
    one, two = hashes(out), hashes(other)
    return sorted(name for name in one.keys() | two.keys() if one.get(name) != two.get(name))


def hashes(folder: Path) -> dict[str, str]:
    """Hash every file of a result; those that tell times count as being there."""
    files = [path for path in folder.rglob("*") if path.is_file()] if folder.exists() else []
    return {
        name: "" if name in TIMED else hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if not (name := path.relative_to(folder).as_posix()).startswith(".stages/")
    }


if __name__ == "__main__":
    sys.exit(main())
