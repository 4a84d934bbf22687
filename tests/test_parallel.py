import threading
import time
from contextvars import ContextVar

import pytest
import torch

from pimper_torch.runtime.events import Progress
from pimper_torch.runtime.parallel import num_workers, over_rows, side_by_side
from pimper_torch.runtime.progress import track
from pimper_torch.runtime.stream import collected

COLOUR: ContextVar[str] = ContextVar("colour", default="none")


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_results_have_the_order_of_the_items(two_threads):
    def work(item):
        time.sleep(0.02 if item % 2 == 0 else 0)
        return item * item

    assert list(side_by_side(work, range(9))) == [item * item for item in range(9)]


def test_two_items_are_processed_in_parallel(two_threads):
    both = threading.Barrier(2, timeout=10)
    assert list(side_by_side(lambda _: both.wait() >= 0, range(2))) == [True, True]


def test_workers_have_one_thread_each_and_torch_restores_its_threads(two_threads):
    inside = list(side_by_side(lambda _: (torch.get_num_threads(), num_workers()), range(4)))
    assert inside == [(1, 1)] * 4
    assert torch.get_num_threads() == 2
    assert list(side_by_side(lambda _: torch.get_num_threads(), range(1))) == [1]
    assert torch.get_num_threads() == 2


def test_workers_inherit_the_callers_context_and_grad_mode(two_threads):
    token = COLOUR.set("red")
    with torch.no_grad():
        seen = list(side_by_side(lambda _: (COLOUR.get(), torch.is_grad_enabled()), range(3)))
    COLOUR.reset(token)
    assert seen == [("red", False)] * 3
    assert all(side_by_side(lambda _: torch.is_grad_enabled(), range(3)))


@pytest.mark.parametrize("inference", [True, False])
def test_workers_inherit_inference_mode_and_write_into_its_tensors(two_threads, inference):
    with torch.inference_mode(inference):
        rows = torch.zeros(3, 2)
        done = side_by_side(lambda row: rows[row].fill_(row).requires_grad, range(3))
        assert not any(done)
    assert rows[:, 0].tolist() == [0, 1, 2]


def test_nested_work_stays_in_its_worker(two_threads):
    def outer(item):
        here = threading.get_ident()
        return all(side_by_side(lambda _: threading.get_ident() == here, range(3)))

    assert all(side_by_side(outer, range(3)))


def test_the_first_failure_in_order_is_raised_and_stops_new_work(two_threads):
    begun = []

    def work(item):
        begun.append(item)
        if item >= 1:
            raise ValueError(f"item {item}")
        return item

    with pytest.raises(ValueError, match="item 1"):
        list(side_by_side(work, range(100)))
    assert len(begun) < 10
    assert torch.get_num_threads() == 2


def test_at_most_one_result_per_worker_is_pending(two_threads):
    begun = []
    results = side_by_side(lambda item: begun.append(item), range(100))
    next(results)
    time.sleep(0.1)
    results.close()
    assert len(begun) <= 4


def test_progress_counts_items_and_ignores_their_inner_progress(two_threads):
    with collected(Progress) as progress:
        list(side_by_side(lambda _: list(track(range(7))), range(3)))
        list(side_by_side(lambda _: None, range(3), tracked=False))
    assert progress == [Progress(done=done, total=3) for done in (1, 2, 3)]


@pytest.mark.parametrize(("rows", "size", "parts"), [(40_000, 1, 2), (100, 1, 1), (100, 400, 2)])
def test_ranges_partition_all_rows_in_order(two_threads, rows, size, parts):
    found = over_rows(lambda given, first, last: (given, first, last), rows, "it", size=size)
    assert [each[0] for each in found] == ["it"] * parts
    assert [each[1:] for each in found] == [
        (part * rows // parts, (part + 1) * rows // parts) for part in range(parts)
    ]
