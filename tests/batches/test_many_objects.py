"""Outcomes of objects with any executor, however their runs or workers end."""

import csv
import os
import shutil
import time
from concurrent.futures import (
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from multiprocessing import get_context
from platform import node

import pytest

from pimper_torch.cli.batches.many_objects import batch
from pimper_torch.cli.batches.objects import read_objects
from pimper_torch.cli.batches.plan import planned_batch
from pimper_torch.cli.batches.task import Outcome, is_whole, outcome_of
from pimper_torch.export.result_folder.stages import locked
from pimper_torch.runtime.errors import ConfigError, OutputError


class Inline(Executor):
    """Runs tasks immediately, or raises an error instead."""

    def __init__(self, error=None):
        self.error, self.tasks = error, []

    def submit(self, work, task):
        self.tasks.append(task)
        future = Future()
        if self.error:
            future.set_exception(self.error)
        else:
            future.set_result(work(task))
        return future


class KilledWorker(Exception):  # noqa: N818 - named as in dask.distributed
    pass


def test_a_failed_object_does_not_stop_the_others(world):
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
    assert {one.name for one in world.heard} == {*found}
    assert found["bad"].message == "it is so."
    assert world.begun("bad") == world.begun("odd") == 1  # deterministic failures are not retried
    rows = {row["name"]: row for row in csv.DictReader((world.out / "batch.csv").open())}
    assert rows["good"]["faces"] == "99"
    assert rows["bad"]["message"] == "it is so."
    assert rows["bad"]["faces"] == ""
    page = (world.out / "batch.html").read_text()
    assert "2 of 4 objects" in page


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
def test_a_run_that_is_killed_or_lacks_memory_is_retried(world, ending):
    world.add("ball", f"if tries < 1: {ending}\nend()")
    world.add("doomed", ending)
    found = world.batch()
    assert (found["ball"].status, found["ball"].tries) == ("ended", 2)
    assert (found["doomed"].status, found["doomed"].tries) == ("lost", 2)
    assert found["doomed"].message
    assert world.begun("doomed") == 2


def test_a_run_that_exceeds_its_time_limit_is_killed_and_retried(world):
    world.add("ball", "if tries < 1: os.kill(os.getpid(), signal.SIGSTOP)\nend()")
    world.add("deaf", "signal.signal(signal.SIGTERM, signal.SIG_IGN)\ntime.sleep(600)")
    found = world.batch(time_limit_min=0.02)
    assert (found["ball"].status, found["ball"].tries) == ("ended", 2)
    assert (found["deaf"].status, found["deaf"].tries) == ("lost", 2)
    assert "longer than 0 minutes (`--time-limit`)" in found["deaf"].message


def test_complete_results_are_skipped_and_changed_inputs_refused(world):
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


def test_too_few_photographs_fail_only_their_object(world):
    world.add("ball")
    photos = world.add("cup")
    for name in ("2.png", "3.png"):
        (photos / name).unlink()
    found = world.batch()
    assert (found["ball"].status, found["cup"].status) == ("ended", "failed")
    assert "cup: the number of photographs is 2; needed: at least 4" in found["cup"].message


def test_changes_since_the_result_are_named(world):
    photos, masks = world.add("ball"), world.folder / "masks"
    masks.mkdir()
    for number in range(4):
        shutil.copy(photos / f"{number}.png", masks)
    given = ["--masks", str(masks), "--faces", "500", "--cache", str(world.folder / "cache")]
    assert world.statuses(settings=given) == {"ball": "ended"}
    (world.folder / "cache").mkdir()
    (world.folder / "cache" / "kept").touch()  # the cache belongs to runs, not to the inputs
    assert world.statuses(settings=given) == {"ball": "kept"}
    (masks / "0.png").write_bytes((masks / "0.png").read_bytes() + b"more")
    (photos / "1.png").rename(photos / "5.png")
    (photos / "more.txt").touch()
    given[3] = "600"
    (outcome,) = world.batch(settings=[*given, "--stl"]).values()
    assert outcome.status == "failed"
    assert outcome.message.endswith(
        " Differences since it was made: without --faces 500; with --faces 600, --stl; changed "
        "0.png (--masks); added 5.png (PHOTOS), more.txt (PHOTOS); missing 1.png (PHOTOS)."
    )
    (world.out / ".stages" / "ball.key").write_text("0123456789abcdef0123456789abcdef")
    (outcome,) = world.batch(settings=given).values()
    assert "An earlier version made it, and did not record its settings" in outcome.message


def test_results_inside_the_input_folder_are_not_objects(world):
    world.add("ball")
    out = world.folder / "scans" / "results"
    for status in ("ended", "kept"):
        (one,) = batch(world.folder / "scans", out)
        assert (one.name, one.status) == ("ball", status)


@pytest.mark.parametrize("change", ["settings", "photographs", "result"])
def test_a_result_is_complete_only_for_its_arguments_and_files(world, change):
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
    (again,) = planned_batch(read_objects(world.folder / "scans"), world.out, settings)
    assert isinstance(again, Outcome)
    assert again.status == "failed"


def test_a_repeated_task_keeps_an_existing_result(world):
    world.add("ball")
    recorder = Inline()
    world.batch(executor=recorder)
    (again,) = recorder.tasks
    assert outcome_of(again).status == "kept"
    assert world.begun("ball") == 1


@pytest.mark.parametrize("error", [KilledWorker("gone"), CancelledError(), OSError("cut off")])
def test_objects_lost_by_an_engine_are_reported_and_the_command_resumes(world, error):
    world.add("ball")
    lost = world.batch(executor=Inline(error))["ball"]
    assert lost.status == "lost"
    assert f"its worker was lost, or cannot run it ({type(error).__name__}" in lost.message
    assert world.statuses() == {"ball": "ended"}


def test_a_broken_executor_is_reported_and_keeps_finished_objects(world):
    for name in "abc":
        kills = "if tries < 1: os.kill(os.getppid(), signal.SIGKILL); sys.exit()\nend()"
        world.add(name, kills if name == "b" else "end()")
    with ProcessPoolExecutor(1, mp_context=get_context("fork")) as executor:
        found = world.batch(executor=executor)
    assert {name: one.status for name, one in found.items()} == {
        "a": "ended",
        "b": "lost",
        "c": "lost",
    }
    assert "BrokenProcessPool" in found["c"].message
    assert world.statuses() == {"a": "kept", "b": "ended", "c": "ended"}


def test_the_lock_of_a_running_process_is_reported_and_kept(world):
    """The marker with the inputs of its result is kept."""
    photos = world.add("ball")
    recorder = Inline()
    world.batch(executor=recorder)
    (photos / "0.png").write_bytes((photos / "0.png").read_bytes() + b"more")
    with locked(world.out.resolve() / "ball", world.out / "ball"):
        found = world.batch(overwrite=True)["ball"]
        assert is_whole(recorder.tasks[0])
    assert found.status == "waiting"
    for said in (
        f"{world.out / 'ball'}: another run is writing to it: process {os.getpid()} on {node()}",
        "Wait until it ends, end it if it hangs, or write elsewhere.",
    ):
        assert said in found.message
    assert world.begun("ball") == 1
    assert world.statuses(overwrite=True) == {"ball": "ended"}


class Pressed(BaseException):
    pass


@pytest.mark.parametrize("own", [True, False])
def test_ctrl_c_ends_the_runs_and_the_same_command_resumes(world, own):
    world.add("ball", "if tries < 1: time.sleep(600)\nend()")
    world.add("cup")

    def press(outcome):
        while not world.begun("ball"):
            time.sleep(0.05)
        raise Pressed

    began = time.monotonic()
    with ThreadPoolExecutor(2) as executor:
        given = {"jobs": 2} if own else {"executor": executor}
        with pytest.raises(Pressed):
            batch(world.folder / "scans", world.out, listener=press, **given)
    assert time.monotonic() - began < 20
    rows = {row["name"]: row["status"] for row in csv.DictReader((world.out / "batch.csv").open())}
    assert rows == {"ball": "waiting", "cup": "ended"}
    assert world.statuses() == {"ball": "ended", "cup": "kept"}


def test_a_foreign_table_is_not_replaced(world):
    world.add("ball")
    world.out.mkdir()
    (world.out / "batch.csv").write_text("mine")
    with pytest.raises(OutputError, match=r"batch.csv: was not written by this command"):
        world.batch()
    assert (world.out / "batch.csv").read_text() == "mine"


def test_a_second_batch_into_the_same_folder_is_refused(world):
    world.add("ball")
    with (
        locked(world.out.resolve(), world.out),
        pytest.raises(OutputError, match="another run is writing to it"),
    ):
        world.batch()


@pytest.mark.parametrize(
    "wrong",
    [
        {"jobs": 0},
        {"jobs": 2, "executor": Inline()},
        {"time_limit_min": 0.0},
        {"mem_gb": 0.0},
        {"cpus_per_task": 0},
    ],
)
def test_impossible_numbers_are_refused(world, wrong):
    world.add("ball")
    with pytest.raises(ConfigError):
        world.batch(**wrong)
