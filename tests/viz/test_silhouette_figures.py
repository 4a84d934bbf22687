import torch
from torch.testing import assert_close

from pimper_torch.ground.radiometry import srgb_from_linear
from pimper_torch.records import Silhouettes, Views
from pimper_torch.result.viz.overview import DOUBTED, RELIABLE, border, thumbnails


def test_the_border_of_a_square_is_its_outermost_pixels():
    mask = torch.zeros(9, 9, dtype=torch.bool)
    mask[2:7, 2:7] = True
    wanted = mask.clone()
    wanted[3:6, 3:6] = False
    assert torch.equal(border(mask), wanted)
    assert not border(torch.ones_like(mask)).any()  # the picture's edge is none


def test_every_view_has_its_tile_and_its_silhouette():
    images = torch.linspace(0.1, 0.5, 3)[:, None, None, None].expand(3, 1, 40, 60)
    inside = torch.zeros(3, 40, 60)
    for view in range(3):
        inside[view, 10:30, 20 : 30 + 10 * view] = 0.9
    silhouettes = Silhouettes(
        inside=inside, reliable=torch.tensor([True, True, False]), source="found"
    )
    views = Views(
        images=images,
        sizes_px=torch.tensor([[60, 40]]).expand(3, 2),
        names=("a", "b", "c"),
        focals_px=torch.ones(3),
    )
    sheet = thumbnails(views, silhouettes, range(3), width_px=60, across=2)
    assert sheet.shape == (40, 60, 3)  # two rows of two tiles of 30 x 20
    assert_close(sheet[20:, 30:], torch.ones(20, 30, 3))
    for view, colour in enumerate((RELIABLE, RELIABLE, DOUBTED)):
        top, left = 20 * (view // 2), 30 * (view % 2)
        tile = sheet[top : top + 20, left : left + 30]
        drawn = (tile - torch.tensor(colour)).abs().amax(dim=-1) < 1e-6
        wanted = torch.zeros(20, 30, dtype=torch.bool)
        wanted[5:15, 10 : 15 + 5 * view] = True
        assert torch.equal(drawn, border(wanted))
        grey = srgb_from_linear(images[view, 0, 0, 0])
        assert_close(tile[~drawn], grey.expand(int((~drawn).sum()), 3))
    last = thumbnails(views, silhouettes, [2, 0], width_px=60, across=2)
    assert torch.equal(last, torch.cat([sheet[20:, :30], sheet[:20, :30]], dim=1))
