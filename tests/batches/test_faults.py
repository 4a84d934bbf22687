"""Six real objects on three real workers of Dask, with three faults."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from pimper_torch.cli.batches.engines import dask_workers
from pimper_torch.cli.batches.many_objects import batch
from pimper_torch.cli.main import main

SMALL = "--num-views 6 --width 80 --height 60 --processes 1 --supersample 1"
# Seconds of a try: a run takes 10 of one core, and the machine may be busy.
LIMIT_S = 90
# Bytes that a run is let have: below the 0.7 GB that it takes.
MEMORY = 500e6


@pytest.fixture
def environment(monkeypatch):
    """Let programs import what the tests do, on one thread each."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL", "30s")


def started(stack, *words):
    """Start a program of Dask that ends with the block."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    program = subprocess.Popen([sys.executable, "-m", "dask", *map(str, words)], **quiet)
    stack.callback(program.wait)
    stack.callback(program.kill)
    return program


@pytest.fixture
def dask(environment, tmp_path):
    """Start a scheduler and three workers: its address, and the workers."""
    with ExitStack() as stack:
        told, here = tmp_path / "scheduler.json", ("--host", "127.0.0.1", "--no-dashboard")
        started(stack, "scheduler", *here, "--port", 0, "--scheduler-file", told)
        while not told.exists() or not told.read_text():
            time.sleep(0.1)
        address = json.loads(told.read_text())["address"]
        one = (*here, "--nthreads", 1, "--no-nanny", "--local-directory", tmp_path)
        yield address, [started(stack, "worker", address, *one) for _ in range(3)]


class Faults(threading.Thread):
    """Harms the first run of three objects: its worker dies, it lacks memory, or it hangs."""

    def __init__(self, workers, out):
        super().__init__(daemon=True)
        self.workers, self.out = workers, out
        self.to_come = {"object1": self.kill_worker, "object3": self.take, "object5": self.stop}

    def run(self):
        while self.to_come:
            for name in [*self.to_come]:
                run = run_of(self.out / name)
                if run is not None and self.to_come[name](run):
                    del self.to_come[name]
            time.sleep(0.05)

    def kill_worker(self, run):
        parent = int(status(run, "PPid"))
        assert parent in [worker.pid for worker in self.workers]
        os.kill(parent, signal.SIGKILL)
        return True

    def take(self, run):
        """End a run that holds too much, as the kernel does."""
        if 1024 * int(status(run, "VmRSS").split()[0]) > MEMORY:
            os.kill(run, signal.SIGKILL)
            return True
        return False

    def stop(self, run):
        os.kill(run, signal.SIGSTOP)
        return True


def run_of(folder):
    """Find the process that reconstructs into a folder."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it has just ended
            if str(folder).encode() in path.read_bytes().split(b"\0"):
                return int(path.parent.name)
    return None


def status(process, name):
    return Path(f"/proc/{process}/status").read_text().partition(f"{name}:")[2].splitlines()[0]


def reconstructed(scene, out):
    """Run `pimper reconstruct` by itself."""
    words = f"{scene}/photos -o {out} --sparse {scene}/truth/sparse --masks {scene}/masks"
    ran = subprocess.run(
        [sys.executable, "-m", "pimper_torch", "reconstruct", *words.split(), *SETTINGS],
        capture_output=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    return digests(out)


SETTINGS = ("--preset", "fast", "--no-report")


def digests(out):
    return {
        name: hashlib.sha256((out / name).read_bytes()).hexdigest()
        for name in ("mesh.ply", "mesh.glb", "depth.npz", "lights.json")
    }


@pytest.mark.slow
def test_objects_end_with_the_bits_of_runs_one_by_one_whatever_happens(dask, tmp_path):
    address, workers = dask
    rows, alone = ["name,photos,sparse,masks"], {}
    for number, name in enumerate(("jar", "mug")):
        scene = tmp_path / name
        given = ["render", name, "-o", str(scene), *SMALL.split(), "--seed", str(number), "-q"]
        assert main(given) == 0
        alone[name] = reconstructed(scene, tmp_path / f"{name}_alone")
    of_object = {f"object{number}": ("jar", "mug")[number % 2] for number in range(6)}
    rows += [
        f"{one},{name}/photos,{name}/truth/sparse,{name}/masks" for one, name in of_object.items()
    ]
    (tmp_path / "list.csv").write_text("\n".join(rows) + "\n")
    faults = Faults(workers, tmp_path / "out")
    faults.start()
    with dask_workers(address) as executor:
        outcomes = batch(
            tmp_path / "list.csv",
            tmp_path / "out",
            executor=executor,
            settings=SETTINGS,
            time_limit_min=LIMIT_S / 60,
        )
    assert not faults.to_come
    assert [one.status for one in outcomes] == ["ended"] * 6, outcomes
    for one in outcomes:
        assert digests(tmp_path / "out" / one.name) == alone[of_object[one.name]], one
    tries = {one.name: one.tries for one in outcomes}
    assert min(tries["object3"], tries["object5"]) > 1, outcomes
    assert [worker.poll() is None for worker in workers].count(True) == 2
