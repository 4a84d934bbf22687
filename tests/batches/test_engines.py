"""Real engines on this machine: workers of Dask, jobs of submitit."""

import os
import time
from dataclasses import replace
from platform import node

import pytest
from stand_ins import children_stand_in, write_slurm

from pimper_torch.cli.batches import engines
from pimper_torch.cli.batches.engines import SlurmExecutor, dask_workers
from pimper_torch.cli.batches.objects import read_objects
from pimper_torch.cli.batches.plan import planned_batch
from pimper_torch.cli.batches.task import carry_out
from pimper_torch.cli.main import main


@pytest.fixture
def cluster():
    """Two workers in this process."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=False,
        dashboard_address=None,
        host="127.0.0.1",
        protocol="tcp",
    ) as cluster:
        yield cluster


@pytest.mark.parametrize("own", [True, False])
def test_objects_end_on_workers_of_dask(world, cluster, own):
    for name in "abc":
        world.add(name, f"if tries < {name == 'b':d}: os.abort()\nend()")
    if own:  # as in Python, with any client's executor
        from distributed import Client

        with Client(cluster.scheduler_address, set_as_default=False) as client:
            found = world.batch(executor=client.get_executor(pure=False))
    else:
        with dask_workers(cluster.scheduler_address) as executor:
            found = world.batch(executor=executor)
    assert {one.status for one in found.values()} == {"ended"}
    assert [one.tries for one in found.values()] == [1, 2, 1]
    places = {one.address for one in cluster.workers.values()}
    assert own or {one.place for one in found.values()} <= places


def test_an_object_is_not_tried_again_where_it_was_lost(world, cluster):
    for number in range(4):
        world.add(f"ball{number}", "if tries < 1: os.abort()\nend()")
    with dask_workers(cluster.scheduler_address) as executor:
        world.batch(executor=executor)
    for number in range(4):
        first, second = [
            place for name, event, place in world.heard if (name, event) == (f"ball{number}", "try")
        ]
        assert first != second


@pytest.mark.parametrize("cluster", [pytest.param("local", marks=pytest.mark.slow), "slurm"])
def test_objects_end_as_jobs_of_submitit(world, tmp_path, monkeypatch, cluster):
    # Its jobs are Python processes of their own, which know nothing of this one.
    monkeypatch.setenv("PYTHONPATH", children_stand_in(tmp_path))
    write_slurm(tmp_path / "bin")
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    world.add("ball")
    world.add("bad", "fail('InputError', 2)")
    kills = "if tries < 1: os.kill(os.getppid(), signal.SIGKILL); sys.exit(1)\nend()"
    world.add("cup", kills if cluster == "local" else "if tries < 1: os.abort()\nend()")
    with SlurmExecutor(tmp_path / "jobs", "part", cluster=cluster) as executor:
        found = world.batch(executor=executor)
    assert {name: one.status for name, one in found.items()} == {
        "bad": "failed",
        "ball": "ended",
        "cup": "ended",
    }
    assert found["cup"].tries == 2
    assert world.begun("bad") == 1
    assert found["ball"].place == ("node7" if cluster == "slurm" else node())


def test_jobs_of_submitit_are_cancelled(world, tmp_path):
    started = time.monotonic()
    world.add("ball")

    class Fake:
        cancelled = False

        def done(self):
            return False

        def cancel(self, check):
            Fake.cancelled = True

    with SlurmExecutor(tmp_path / "jobs", cluster="local") as executor:
        executor._executor.submit = lambda *given: Fake()
        executor._executor.update_parameters = lambda **given: None
        (one,) = plan_of(world)
        executor.submit(carry_out, one).cancel()
        while not Fake.cancelled:
            time.sleep(0.05)
            assert time.monotonic() - started < 10


def plan_of(world):
    return planned_batch(read_objects(world.folder / "scans"), world.out).tasks


def test_a_job_asks_for_what_a_task_needs(world, tmp_path):
    world.add("ball")
    (one,) = plan_of(world)
    with SlurmExecutor(tmp_path / "jobs", "long", cluster="local") as executor:
        asked = []
        executor._executor.submit = lambda *given: None
        executor._executor.update_parameters = lambda **given: asked.append(given)
        for avoid in (("", "node3", "node1", "node3"), ()):
            executor.submit(
                carry_out, replace(one, limit_s=90.0, mem_gb=1.2, threads=3, avoid=avoid)
            )
        executor._jobs.clear()
    first, second = asked
    assert first["slurm_exclude"] == "node3,node1"
    assert second["slurm_exclude"] is None
    assert (first["timeout_min"], first["mem_gb"], first["cpus_per_task"]) == (7, 2, 3)
    assert first["slurm_partition"] == "long"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["--dask", "tcp://127.0.0.1:1"], "is tcp://127.0.0.1:1, where no scheduler answers"),
        (["--slurm", "gpu"], "there is no `sbatch` here"),
        (["--dask", "tcp://127.0.0.1:1", "--slurm", "gpu"], "needed: none beside --dask"),
    ],
)
def test_an_engine_that_is_not_there_is_told(world, given, told, capsys, monkeypatch):
    import dask

    world.add("ball")
    monkeypatch.setattr(engines.shutil, "which", lambda _: None)
    monkeypatch.setattr(engines, "_TIMEOUT_SECONDS", 1)
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        assert main(["batch", str(world.folder / "scans"), "-o", str(world.out), *given]) == 2
    assert told in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(("option", "extra"), [("--dask", "dask"), ("--slurm", "slurm")])
def test_an_engine_that_is_not_installed_is_told(world, option, extra, capsys, monkeypatch):
    world.add("ball")
    monkeypatch.setattr(engines, "find_spec", lambda _: None)
    assert main(["batch", str(world.folder / "scans"), "-o", str(world.out), option, "x"]) == 2
    assert f"pip install 'pimper_torch[{extra}]'" in " ".join(capsys.readouterr().err.split())
