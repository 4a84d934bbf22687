import pytest

from pimper_torch.errors import ReconstructionError
from pimper_torch.sfm.components import choose_component

NAMES = tuple(f"{index:02d}.jpg" for index in range(20))


def test_the_largest_component_is_kept_when_it_is_a_clear_majority():
    assert choose_component([NAMES[:4], NAMES[4:20]], NAMES, 0.6) == 1


def test_a_small_model_without_a_rival_is_kept():
    assert choose_component([NAMES[:5]], NAMES, 0.6) == 0


def test_a_component_inside_the_largest_one_is_no_rival():
    assert choose_component([NAMES[:8], NAMES[2:8]], NAMES, 0.6) == 0


def test_a_split_in_halves_is_refused_with_sizes_names_and_advice():
    with pytest.raises(ReconstructionError) as caught:
        choose_component([NAMES[:9], NAMES[9:16]], NAMES, 0.6)
    message = str(caught.value)
    assert "split 20 photographs into 2 models" in message
    assert "9 photographs (00.jpg" in message
    assert "7 photographs (09.jpg" in message
    assert "add photographs between" in message


@pytest.mark.parametrize("parts", [[], [NAMES[:2]], [NAMES[:2], NAMES[2:4]]])
def test_fewer_than_three_views_are_refused_with_how_many_and_which(parts):
    with pytest.raises(ReconstructionError, match="at least 3 are needed") as caught:
        choose_component(parts, NAMES[:6], 0.6)
    message = str(caught.value)
    assert f"registered {len(parts[0]) if parts else 0} of 6 photographs" in message
    assert "05.jpg" in message
    assert ("00.jpg" in message) == (not parts)
