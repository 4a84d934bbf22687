import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from pimper_torch.io.cameras.camera_arrays import decompose_projections


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31))
def test_a_projection_is_decomposed_into_its_camera(seed):
    """The decomposition is unique, independent of the projection's factor."""
    generator = torch.Generator().manual_seed(seed)
    P = torch.randn(3, 3, 4, generator=generator, dtype=torch.float64)
    P = P * torch.tensor([1.0, -250.0, 3e-4]).double()[:, None, None]
    assume(torch.linalg.cond(P[:, :, :3]).max() < 1e3)
    K, pose = decompose_projections(P)
    assert torch.equal(K, K.triu())
    assert (K.diagonal(dim1=1, dim2=2) > 0).all()
    assert (K[:, 2, 2] == 1).all()
    rotation = pose[:, :3, :3]
    assert_close(rotation @ rotation.mT, torch.eye(3).double().expand(3, 3, 3))
    assert_close(torch.linalg.det(rotation), torch.ones(3).double())
    again = K @ pose[:, :3]
    assert_close(again / again[:, 2:, 3:], P / P[:, 2:, 3:], rtol=1e-8, atol=1e-8)


def test_an_invalid_projection_is_an_error():
    P = torch.stack([torch.eye(3, 4), torch.ones(3, 4)]).double()
    with pytest.raises(ValueError, match="number 1 has no inverse"):
        decompose_projections(P)
