from pimper_torch.runtime.progress import listening, part, report, track


def test_every_batch_is_reported_with_the_total():
    heard = []
    with listening(lambda done, total: heard.append((done, total))):
        walked = list(track(["a", "b", "c"]))
    assert walked == ["a", "b", "c"]
    assert heard == [(1, 3), (2, 3), (3, 3)]


def test_progress_needs_no_listener_and_listeners_end_with_their_block():
    heard = []
    with listening(lambda done, total: heard.append(done)):
        pass
    report(1, 1)
    assert heard == []


def test_the_inner_listener_replaces_the_outer_one_within_its_block():
    outer, inner = [], []
    with listening(lambda done, total: outer.append(done)):
        with listening(lambda done, total: inner.append(done)):
            report(1, 2)
        report(2, 2)
    assert inner == [1]
    assert outer == [2]


def test_parts_of_a_stage_share_one_bar_and_nest():
    heard = []
    with listening(lambda done, total: heard.append(done / total)):
        with part(0, 2):
            list(track("ab"))
        with part(1, 2):
            with part(0, 2):
                report(1, 4)
            report(3, 4)
    assert heard == [0.25, 0.5, 0.5, 0.5625, 0.75, 0.875, 1.0]
