"""Real engines on the local machine: Dask workers, submitit jobs."""

import os
import sys
from platform import node

import pytest
from stand_ins import children_stand_in, write_slurm

from pimper_torch.cli.batches import engines
from pimper_torch.cli.batches.engines import SlurmExecutor, dask_workers
from pimper_torch.cli.batches.many_objects import batch
from pimper_torch.cli.batches.task import Outcome
from pimper_torch.cli.main import main


@pytest.fixture(scope="module")
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


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """Stand-ins for Slurm's commands and for the runs of its jobs."""
    # Jobs are separate Python processes without the patches of this one.
    monkeypatch.setenv("PYTHONPATH", children_stand_in(tmp_path))
    write_slurm(tmp_path / "bin")
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")


@pytest.mark.parametrize("own", [True, False])
def test_objects_end_on_workers_of_dask(world, cluster, own):
    for name in "abc":
        world.add(name, f"if tries < {name == 'b':d}: os.abort()\nend()")
    if own:  # as in Python, with the executor of a client
        from distributed import Client

        with Client(cluster.scheduler_address, set_as_default=False) as client:
            found = world.batch(executor=client.get_executor(pure=False))
    else:
        with dask_workers(cluster.scheduler_address) as executor:
            found = world.batch(executor=executor)
    assert {one.status for one in found.values()} == {"ended"}
    assert [one.tries for one in found.values()] == [1, 2, 1]


@pytest.mark.slow
def test_no_object_is_lost_if_a_dask_worker_dies(world, tmp_path, monkeypatch):
    from distributed import LocalCluster

    monkeypatch.setenv("PYTHONPATH", children_stand_in(tmp_path))
    kills = "if tries < 1: os.kill(os.getppid(), signal.SIGKILL); sys.exit()\nend()"
    for name in "abc":
        world.add(name, kills if name == "b" else "end()")
    with (
        LocalCluster(2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1") as cluster,
        dask_workers(cluster.scheduler_address) as executor,
    ):
        assert {*world.statuses(executor=executor).values()} <= {"ended", "kept"}
    assert world.begun("b") == 2


@pytest.mark.usefixtures("slurm")
def test_objects_end_as_jobs_of_slurm(world, tmp_path):
    world.add("bad", "fail('InputError', 2)")
    world.add("cup", "if tries < 1: os.abort()\nend()")
    with SlurmExecutor(tmp_path / "jobs", 2, "part") as executor:
        found = world.batch(executor=executor)
    assert {name: one.status for name, one in found.items()} == {"bad": "failed", "cup": "ended"}
    assert (found["cup"].tries, world.begun("bad"), found["cup"].place) == (2, 1, node())


@pytest.mark.usefixtures("slurm")
def test_jobs_request_the_resources_of_a_task_and_are_cancelled_with_the_batch(world, tmp_path):
    asked, cancelled = [], []

    class Job:
        def __init__(self, work, task):
            self.task = task

        def done(self):
            return self.task.name == "cup"

        def result(self):
            return Outcome(name="cup", status="failed")

        def cancel(self, check):
            cancelled.append(self.task.name)

    class Pressed(BaseException):
        pass

    def press(outcome):
        raise Pressed

    world.add("ball")
    world.add("cup")
    with SlurmExecutor(tmp_path / "jobs", 2, "long") as executor:
        executor._executor.submit = Job
        executor._executor.update_parameters = lambda **given: asked.append(given)
        needs = {"time_limit_min": 1.5, "mem_gb": 1.2, "cpus_per_task": 3}
        with pytest.raises(Pressed):
            batch(world.folder / "scans", world.out, executor=executor, listener=press, **needs)
    assert cancelled == ["ball"]
    first, _ = asked
    assert (first["timeout_min"], first["mem_gb"], first["cpus_per_task"]) == (7, 2, 3)
    assert first["slurm_partition"] == "long"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--dask", "tcp://127.0.0.1:1"], "is tcp://127.0.0.1:1, where no scheduler answers"),
        (["--slurm", "gpu"], "`sbatch` is not found"),
        (["--dask", "tcp://127.0.0.1:1", "--slurm", "gpu"], "needed: no value together with --d"),
        (["--jobs", "0"], "needed: at least 1"),
    ],
)
def test_an_unreachable_engine_is_reported(world, given, said, capsys, monkeypatch):
    import dask

    world.add("ball")
    monkeypatch.setattr(engines.shutil, "which", lambda _: None)
    monkeypatch.setattr(engines, "_TIMEOUT_SECONDS", 1)
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        assert main(["batch", str(world.folder / "scans"), "-o", str(world.out), *given]) == 2
    assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(("engine", "extra"), [("distributed", "dask"), ("submitit", "slurm")])
def test_an_engine_that_is_not_installed_is_reported(world, engine, extra, capsys, monkeypatch):
    world.add("ball")
    monkeypatch.setitem(sys.modules, engine, None)
    given = [str(world.folder / "scans"), "-o", str(world.out), f"--{extra}", "x"]
    assert main(["batch", *given]) == 2
    assert f"pip install 'pimper_torch[{extra}]'" in " ".join(capsys.readouterr().err.split())
