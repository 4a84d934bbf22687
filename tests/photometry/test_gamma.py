"""The gamma of photographs that the chain registered."""

from torch.testing import assert_close

from pimper_torch.radiometry import Gamma
from pimper_torch.single_view.factorization.gamma import gamma_of_patches


def test_registered_photographs_tell_their_gamma(scene):
    seen = scene().seen
    curve = Gamma(exponent=2.2)
    brightest = max(float(each.radiance.max()) for each in seen.buckets)
    buckets = tuple(
        each.replace(radiance=curve.encoded_from_linear(each.radiance / (1.1 * brightest)))
        for each in seen.buckets
    )
    found = gamma_of_patches(seen.replace(buckets=buckets), max_samples=120)
    assert_close(found.gamma, 2.2, rtol=5e-3, atol=0)
    assert found.determined
