"""Events reach the listeners of their call, from the innermost outwards."""

import warnings
from contextlib import suppress

from pimper_torch.runtime.errors import PimperWarning, caution, held
from pimper_torch.runtime.events import Caution, Event, Progress
from pimper_torch.runtime.progress import part, report, track
from pimper_torch.runtime.stream import collected, emit


def fractions(events):
    return [event.done / event.total for event in events]


def test_an_event_that_is_collected_inside_is_unheard_outside_unless_passed_on():
    with collected(Progress) as outer:
        with collected(Progress, passed_on=True) as passed, collected(Caution):
            assert list(track("ab")) == ["a", "b"]
        with collected(Progress) as inner:
            report(3, 4)
    assert fractions(outer) == fractions(passed) == [0.5, 1]
    assert fractions(inner) == [0.75]


def test_an_event_without_a_listener_is_unheard():
    with collected(Progress) as ended:
        pass
    with collected(Event, passed_on=True) as nothing:
        assert not emit(Progress(done=1, total=1))
    assert ended == nothing == []


def test_parts_of_a_stage_share_one_bar_and_nest():
    with collected(Progress) as heard:
        with part(0, 2):
            list(track("ab"))
        with part(1, 2):
            with part(0, 2):
                report(1, 4)
            report(3, 4)
    assert fractions(heard) == [0.25, 0.5, 0.5, 0.5625, 0.75, 0.875, 1.0]


def test_a_caution_warns_at_its_line_unless_it_is_held(recwarn, pytestconfig):
    warnings.simplefilter("always")
    with held() as cautions, held() as inner:
        caution("held")
    with collected(Caution, passed_on=True) as heard:
        caution("now")
    with suppress(ValueError), held():
        caution("late")
        raise ValueError
    assert [str(one.message) for one in recwarn] == ["now", "late"]
    assert {one.category for one in recwarn} == {PimperWarning}
    assert (cautions, inner, heard) == ([], [Caution(message="held")], [Caution(message="now")])
    if not pytestconfig.getoption("jaxtyping_packages"):  # which adds frames to the stack
        assert recwarn[0].filename == __file__
