import torch
from torch.testing import assert_close

from pimper_torch.coarse.oriented import fitted_planes
from pimper_torch.kernels.switch import using


def test_planes_are_those_that_torch_fits():
    generator = torch.Generator().manual_seed(0)
    rough = 0.001 * torch.randn(40, 53, generator=generator)
    depth = 0.3 + rough.cumsum(dim=0) / 4 + 0.05 * (torch.arange(53) > 30)
    valid = torch.rand(40, 53, generator=generator) > 0.2
    found = fitted_planes(depth, valid, 0.001)
    with using("torch"):
        expected = fitted_planes(depth, valid, 0.001)
    assert 0.1 < float(found[3].double().mean()) < 0.8  # some fine, some not
    for one, other in zip(found[:3], expected[:3], strict=True):
        assert_close(one, other, atol=1e-7, rtol=1e-5)
    assert float((found[3] != expected[3]).double().mean()) < 2e-3  # limits met within rounding


def test_nothing_valid_gets_no_plane():
    depth = torch.full((6, 7), 0.5)
    inverse_depth, slope, _, fine = fitted_planes(depth, torch.zeros_like(depth) > 0, 0.001)
    assert_close(inverse_depth, depth)
    assert not bool(slope.any())
    assert not bool(fine.any())
