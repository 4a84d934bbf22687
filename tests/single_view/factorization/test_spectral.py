import torch
from torch.testing import assert_close

from pimper_torch.single_view.factorization.spectral import upgrade_to_cone


def test_vectors_are_brought_to_the_cone(problem, generator):
    _, lights, shading = problem(patches=1)
    hidden = torch.randn(4, 4, generator=generator, dtype=torch.float64)
    even = torch.ones_like(shading[0, 0])
    L, N = upgrade_to_cone(lights[0] @ torch.linalg.inv(hidden), hidden @ shading[0], even)
    assert_close(L @ N, lights[0] @ shading[0])
    assert_close(N[0], N[1:].norm(dim=0), rtol=1e-5, atol=1e-6)
