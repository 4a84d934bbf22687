import torch

from pimper_torch.coarse.densify import DepthMaps
from pimper_torch.coarse.matching import Level
from pimper_torch.coarse.oriented import denied
from pimper_torch.evidence.scenes.cameras import arc_cameras
from pimper_torch.kernels.switch import using


def test_points_are_denied_by_as_many_views_as_torch_says():
    generator = torch.Generator().manual_seed(0)
    cameras = arc_cameras(5, width=40, height=30, focal_px=45.0, distance=4.0, sway_deg=10.0).to(
        torch.float32
    )
    tone = torch.ones(5, 30, 40)
    maps = DepthMaps(
        factor=1,
        level=Level(tone=tone, usable=tone > 0, cameras=cameras),
        inverse_depth=0.25 + 0.02 * torch.randn(5, 30, 40, generator=generator),
        agreed=tone.long(),
        valid=torch.rand(5, 30, 40, generator=generator) > 0.2,
        step=torch.linspace(0.001, 0.01, 5),
        sources=torch.zeros(5, 2, dtype=torch.long),
    )
    # Some outside every picture, some behind cameras.
    points = 3 * torch.randn(5000, 3, generator=generator)
    found = denied(maps, 1, points)
    with using("torch"):
        expected = denied(maps, 1, points)
    assert int(expected.max()) >= 3
    assert int((expected == 0).sum()) > 500
    assert float((found != expected).double().mean()) < 1e-3  # pixels met within rounding
