"""What becomes of objects: with any executor, whatever ends their runs or the workers."""

import csv
import json
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from platform import node

import pytest

from pimper_torch.cli.batches import many_objects, task
from pimper_torch.cli.batches.task import carry_out, is_whole
from pimper_torch.runtime.errors import ConfigError, OutputError


class Inline(Executor):
    """Carries out at once, and loses what it is told to."""

    def __init__(self, lose=()):
        self.lose, self.tasks = list(lose), []

    def submit(self, work, task):
        self.tasks.append(task)
        future = Future()
        if self.lose:
            future.set_exception(self.lose.pop(0))
        else:
            future.set_result(work(task))
        return future


class KilledWorker(Exception):  # noqa: N818 - as that of dask.distributed
    pass


def test_every_object_ends_and_one_that_fails_stops_no_other(world):
    world.add("good")
    world.add("bad", "fail('InputError', 2)")
    world.add("odd", "fail('KeyError', 1)")
    world.add("other")
    found = world.batch(jobs=2)
    assert {name: one.status for name, one in found.items()} == {
        "bad": "failed",
        "good": "ended",
        "odd": "failed",
        "other": "ended",
    }
    assert [*found] == sorted(found)  # in the order of the list
    assert found["bad"].message == "it is so."
    assert world.begun("bad") == world.begun("odd") == 1  # a failure of its own, never again
    rows = {row["name"]: row for row in csv.DictReader((world.out / "batch.csv").open())}
    assert rows["good"]["faces"] == "99"
    assert rows["bad"]["message"] == "it is so."
    assert rows["bad"]["faces"] == ""
    page = (world.out / "batch.html").read_text()
    assert "2 of 4 objects" in page
    assert ("good", "stage-begin", "read") in world.heard


@pytest.mark.parametrize(
    "ending",
    [
        "os.kill(os.getpid(), signal.SIGKILL)",
        "os.abort()",
        "fail('MemoryError', 2)",
        "fail('OutOfMemoryError', 2)",
        "sys.exit(143)",
        "os._exit(1)",
    ],
)
def test_a_run_that_is_killed_or_lacks_memory_is_tried_again(world, ending):
    world.add("ball", f"if tries < 1: {ending}\nend()")
    world.add("doomed", ending)
    found = world.batch(tries=2)
    assert (found["ball"].status, found["ball"].tries) == ("ended", 2)
    assert (found["doomed"].status, found["doomed"].tries) == ("lost", 2)
    assert found["doomed"].message
    assert world.begun("doomed") == 2


def test_a_run_that_hangs_is_ended_at_its_limit(world):
    world.add("ball", "if tries < 1: os.kill(os.getpid(), signal.SIGSTOP)\nend()")
    found = world.batch(time_limit_min=0.02)
    assert (found["ball"].status, found["ball"].tries) == ("ended", 2)


def test_a_run_that_heeds_no_signal_is_killed(world):
    world.add("deaf", "signal.signal(signal.SIGTERM, signal.SIG_IGN)\ntime.sleep(600)")
    found = world.batch(time_limit_min=0.02, tries=1)
    assert found["deaf"].status == "lost"
    assert "longer than 0 minutes (`--time-limit`)" in found["deaf"].message


def test_what_is_whole_is_passed_over_and_what_changed_is_refused(world):
    photos = world.add("ball")
    world.add("cup", "if tries < 3: fail('InputError', 2)\nend()")
    assert world.statuses() == {"ball": "ended", "cup": "failed"}
    assert world.statuses() == {"ball": "kept", "cup": "failed"}
    assert (world.begun("ball"), world.begun("cup")) == (1, 2)
    assert world.statuses(overwrite=True) == {"ball": "kept", "cup": "failed"}
    assert world.statuses(settings=["--overwrite"]) == {"ball": "kept", "cup": "ended"}
    (photos / "0.png").write_bytes((photos / "0.png").read_bytes() + b"more")
    found = world.batch()
    assert found["ball"].status == "failed"
    assert "--overwrite" in found["ball"].message
    assert world.begun("ball") == 1
    assert world.statuses(overwrite=True) == {"ball": "ended", "cup": "kept"}


def test_results_inside_the_list_are_no_objects(world):
    world.add("ball")
    out = world.folder / "scans" / "results"
    for status in ("ended", "kept"):
        (one,) = many_objects.batch(world.folder / "scans", out)
        assert (one.name, one.status) == ("ball", status)


@pytest.mark.parametrize("change", ["settings", "photographs", "result"])
def test_a_result_is_whole_for_its_arguments_and_files_and_after_its_run_began(world, change):
    photos = world.add("ball")
    recorder = Inline()
    assert world.statuses(executor=recorder) == {"ball": "ended"}
    (one,) = recorder.tasks
    assert is_whole(one)
    if change == "settings":
        settings = ("--faces", "500")
    else:
        settings = ()
        path = photos / "0.png" if change == "photographs" else world.out / "ball" / ".pimper.json"
        path.write_bytes(b"changed")
        os.utime(path, (0, 0))
    (again,) = many_objects.planned_batch(
        many_objects.read_objects(world.folder / "scans"), world.out, settings, overwrite=False
    ).settled
    assert again.status == "failed"


@pytest.mark.parametrize("error", [KilledWorker("gone"), CancelledError(), OSError("cut off")])
def test_a_worker_that_is_lost_has_its_object_tried_elsewhere(world, error):
    world.add("ball")
    executor = Inline([error])
    found = world.batch(executor=executor)
    assert (found["ball"].status, found["ball"].tries) == ("ended", 2)
    first, second = executor.tasks
    assert first.token != second.token
    assert len(second.avoid) == 1


def test_a_worker_that_cannot_work_fails_the_object(world):
    world.add("ball")
    found = world.batch(executor=Inline([ModuleNotFoundError("no pimper_torch")]))
    assert found["ball"].status == "failed"
    assert "cannot carry it out (ModuleNotFoundError: no pimper_torch)" in found["ball"].message


def test_an_executor_that_breaks_leaves_what_ended_and_says_so(world):
    for name in "abc":
        kills = "if tries < 1: os.kill(os.getppid(), signal.SIGKILL); sys.exit()\nend()"
        world.add(name, kills if name == "b" else "end()")
    with ProcessPoolExecutor(1, mp_context=get_context("fork")) as executor:
        found = world.batch(executor=executor, jobs=1)
    assert found["a"].status == "ended"
    assert found["b"].status == "waiting"
    assert "takes no more work (BrokenProcessPool" in found["c"].message
    assert world.statuses() == {"a": "kept", "b": "ended", "c": "ended"}


def test_a_worker_that_does_not_answer_is_given_up_and_its_late_answer_is_ignored(
    world, monkeypatch
):
    monkeypatch.setattr(many_objects, "_SILENCE_SECONDS", 0.2)
    world.add("ball")
    late = []

    class Hangs(Inline):
        def submit(self, work, one):
            if self.tasks:
                return super().submit(work, one)
            self.tasks.append(one)
            with one.log.open("ab") as log:
                log.write(b'{"event": "try", "place": "far", "host": "far", "process": 1}\n')
            late.append(Future())
            return late[0]

    executor = Hangs()
    found = world.batch(executor=executor, time_limit_min=0.05)  # of a child that imports
    assert (found["ball"].status, found["ball"].tries) == ("ended", 2)
    assert executor.tasks[1].avoid == ("far",)
    assert ("ball", "lost", True) in world.heard
    assert late[0].cancelled()


def test_a_try_ends_when_another_takes_its_place(world):
    world.add("ball", "time.sleep(600)")
    recorder = Inline([CancelledError()])
    world.batch(executor=recorder, tries=1)
    one = recorder.tasks[0]
    lease = one.beside(".lease")
    lease.parent.mkdir(parents=True, exist_ok=True)
    lease.write_text(one.token)
    threading.Timer(0.5, lease.write_text, ["another"]).start()
    ended = carry_out(one)
    assert (ended.status, ended.message) == ("lost", "it was stopped.")
    assert ended.seconds < 5


HOLDS = """
import fcntl, os, sys, time
lock = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT)
fcntl.flock(lock, fcntl.LOCK_EX)
print("held", flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("ours", [True, False])
def test_the_lock_of_a_run_that_does_not_end_is_taken_from_it_if_a_try_began_it(
    world, monkeypatch, ours
):
    monkeypatch.setattr(task, "_SILENCE_SECONDS", 0.2)
    world.add("ball")
    recorder = Inline([CancelledError()])
    world.batch(executor=recorder, tries=1)
    one = replace(recorder.tasks[0], limit_s=3.0)
    for folder in (one.out, one.out.parent):
        (folder / ".stages").mkdir(parents=True, exist_ok=True)
    one.beside(".lease").write_text(one.token)
    frozen = subprocess.Popen(
        [sys.executable, "-c", HOLDS, one.out / ".stages" / "lock"], stdout=subprocess.PIPE
    )
    frozen.stdout.readline()
    (one.out / ".stages" / "holder.txt").write_text(f"process {frozen.pid} on {node()} since then")
    number = frozen.pid if ours else frozen.pid + 1
    one.log.write_text(json.dumps({"event": "try", "host": node(), "process": number}) + "\n")
    ended = carry_out(one)
    frozen.kill()
    frozen.wait()
    assert ended.status == ("ended" if ours else "lost")
    if not ours:
        assert f"another run writes to {one.out}" in ended.message


def test_ctrl_c_ends_the_runs_and_the_same_command_goes_on(world):
    world.add("ball", "if tries < 1: time.sleep(600)\nend()")
    world.add("cup")

    class Pressed(BaseException):
        pass

    class Presses:
        def progressed(self, name, event):
            if name == "ball":
                raise Pressed

        def settled(self, outcome, again):
            pass

    began = time.monotonic()
    with pytest.raises(Pressed):
        many_objects.batch(world.folder / "scans", world.out, jobs=1, listener=Presses())
    assert time.monotonic() - began < 20
    rows = {row["name"]: row for row in csv.DictReader((world.out / "batch.csv").open())}
    assert rows["ball"]["status"] == rows["cup"]["status"] == "waiting"
    assert world.statuses() == {"ball": "ended", "cup": "ended"}


def test_a_table_that_is_not_ours_is_not_replaced(world):
    world.add("ball")
    world.out.mkdir()
    (world.out / "batch.csv").write_text("mine")
    with pytest.raises(OutputError, match=r"batch.csv: was not written by this command"):
        world.batch()
    assert (world.out / "batch.csv").read_text() == "mine"


def test_two_batches_do_not_write_to_one_folder(world):
    world.add("ball")
    with (
        many_objects.locked(world.out.resolve(), world.out),
        pytest.raises(OutputError, match="another run writes there"),
    ):
        world.batch()


@pytest.mark.parametrize(
    "wrong",
    [{"jobs": 0}, {"tries": 0}, {"time_limit_min": 0.0}, {"mem_gb": 0.0}, {"cpus_per_task": 0}],
)
def test_impossible_numbers_are_refused(world, wrong):
    world.add("ball")
    with pytest.raises(ConfigError):
        world.batch(**wrong)
