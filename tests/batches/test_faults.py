"""Twelve real objects on three real workers of Dask, with three faults."""

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
# Seconds of a try, and of the whole: a run takes 10 of one core, and the machine may be busy.
LIMIT_S, LONGEST_S = 60, 900
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


class Faults:
    """Harms the first run of three objects: where its worker dies, it lacks memory, it hangs."""

    def __init__(self, workers):
        self.workers, self.harmed, self.lost = workers, set(), []

    def progressed(self, name, event):
        if event["event"] != "try" or name in self.harmed:
            return
        harm = {"object03": self.kill_worker, "object05": self.take_memory, "object07": self.stop}
        if name in harm:
            self.harmed.add(name)
            threading.Thread(target=harm[name], args=[event["process"]], daemon=True).start()

    def settled(self, outcome, again):
        if again:
            self.lost.append((outcome.name, outcome.message))

    def kill_worker(self, run):
        time.sleep(4)
        parent = int(Path(f"/proc/{run}/stat").read_text().rpartition(")")[2].split()[1])
        assert parent in [worker.pid for worker in self.workers]
        os.kill(parent, signal.SIGKILL)

    def take_memory(self, run):
        """End a run that holds too much, as the kernel does."""
        with suppress(FileNotFoundError):
            while True:
                told = Path(f"/proc/{run}/status").read_text()
                if 1024 * int(told.partition("VmRSS:")[2].split()[0]) > MEMORY:
                    os.kill(run, signal.SIGKILL)
                    return
                time.sleep(0.05)

    def stop(self, run):
        time.sleep(3)
        os.kill(run, signal.SIGSTOP)


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
def test_twelve_objects_end_with_the_bits_of_runs_one_by_one_whatever_happens(dask, tmp_path):
    address, workers = dask
    rows, alone = ["name,photos,sparse,masks"], {}
    for number, name in enumerate(("jar", "mug")):
        scene = tmp_path / name
        given = ["render", name, "-o", str(scene), *SMALL.split(), "--seed", str(number), "-q"]
        assert main(given) == 0
        alone[name] = reconstructed(scene, tmp_path / f"{name}_alone")
    of_object = {f"object{number:02d}": ("jar", "mug")[number % 2] for number in range(12)}
    rows += [
        f"{one},{name}/photos,{name}/truth/sparse,{name}/masks" for one, name in of_object.items()
    ]
    (tmp_path / "list.csv").write_text("\n".join(rows) + "\n")
    faults, began = Faults(workers), time.monotonic()
    with dask_workers(address) as executor:
        outcomes = batch(
            tmp_path / "list.csv",
            tmp_path / "out",
            executor=executor,
            settings=SETTINGS,
            time_limit_min=LIMIT_S / 60,
            tries=5,
            listener=faults,
        )
    assert time.monotonic() - began < LONGEST_S
    assert [one.status for one in outcomes] == ["ended"] * 12, outcomes
    for one in outcomes:
        assert digests(tmp_path / "out" / one.name) == alone[of_object[one.name]], one
    assert len(faults.harmed) == 3
    said = dict(faults.lost)
    assert "SIGKILL" in said["object05"]
    assert "`--time-limit`" in said["object07"]
    assert [worker.poll() is None for worker in workers].count(True) == 2
