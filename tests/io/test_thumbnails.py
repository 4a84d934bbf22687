"""Photographs are recognised by thumbnails, independent of their size and padding."""

import pytest
import torch
from sparse_models import views_of
from torch.nn.functional import pad

from pimper_torch.io.thumbnails import compare_thumbnails, thumbnails
from pimper_torch.radiometry import to_bytes
from pimper_torch.runtime.errors import InputError, PimperWarning


@pytest.fixture
def images():
    return torch.rand(3, 3, 24, 40, generator=torch.Generator().manual_seed(71))


def test_the_thumbnail_of_a_uniform_photograph_is_its_grey_level():
    color = torch.tensor([0.1, 0.2, 0.3])[:, None, None].expand(1, 3, 24, 40)
    (found,) = thumbnails(views_of(color)).values()
    assert bytes.fromhex(found) == bytes([int(to_bytes(torch.tensor(0.2)))] * 64)


def test_neither_a_resize_nor_padding_changes_thumbnails(images):
    larger = images.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
    padded = views_of(pad(images, (0, 7, 0, 5), value=0.9), [(40, 24)] * 3)
    assert thumbnails(views_of(images)) == thumbnails(views_of(larger)) == thumbnails(padded)


def test_reordered_photographs_are_refused_and_new_ones_are_not(images):
    known = thumbnails(views_of(images))
    with pytest.raises(InputError, match=r"0\.png is 2\.png, 2\.png is 0\.png; needed"):
        compare_thumbnails(views_of(images.flip(0)), known, "photographs")
    changed = images.clone()
    changed[1] *= 0.5
    with pytest.warns(PimperWarning, match=r"have changed: 1\.png"):
        compare_thumbnails(views_of(changed), known, "photographs")
