from pimper_torch.progress import listening, report, track


def test_every_batch_is_reported_with_the_total():
    heard = []
    with listening(lambda done, total: heard.append((done, total))):
        walked = list(track(["a", "b", "c"]))
    assert walked == ["a", "b", "c"]
    assert heard == [(1, 3), (2, 3), (3, 3)]


def test_nobody_listening_is_no_error_and_listeners_do_not_outlive_their_block():
    heard = []
    with listening(lambda done, total: heard.append(done)):
        pass
    report(1, 1)
    assert heard == []


def test_the_inner_listener_hears_and_the_outer_one_comes_back():
    outer, inner = [], []
    with listening(lambda done, total: outer.append(done)):
        with listening(lambda done, total: inner.append(done)):
            report(1, 2)
        report(2, 2)
    assert inner == [1]
    assert outer == [2]
