import torch
from torch.testing import assert_close

from pimper_torch.single_view.factorization.spectral import upgrade_to_cone


def test_vectors_are_brought_to_the_cone_and_a_wrong_signature_is_told(problem, generator):
    _, lights, shading = problem(patches=2)
    hidden = torch.randn(2, 4, 4, generator=generator, dtype=torch.float64)
    # The second patch's vectors lie on a quadric of another signature: no point light lights those.
    x, y, z = torch.randn(3, 150, generator=generator, dtype=torch.float64)
    fourth = (x**2 + z**2 - y**2).abs().sqrt()
    inside = x**2 + z**2 > y**2
    saddle = torch.stack([x, z, y, fourth])[:, inside]
    shading = shading[:, :, : saddle.shape[1]].clone()
    shading[1] = saddle
    even = torch.ones_like(shading[:, 0])
    found = upgrade_to_cone(lights @ torch.linalg.inv(hidden), hidden @ shading, even)
    assert found.lorentzian.tolist() == [True, False]
    assert_close(found.lights @ found.shading, lights @ shading)
    on_cone = found.shading[0, 1:].norm(dim=0)
    assert_close(found.shading[0, 0].abs(), on_cone, rtol=1e-5, atol=1e-6)
    assert (found.shading[0, 0] > 0).all()
