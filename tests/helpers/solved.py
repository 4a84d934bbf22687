"""What a chain makes of samples: light, factorization and gauge, one after the other."""

from pimper_torch.method.photometry.fit_light import FitLight
from pimper_torch.method.photometry.gauge import FixGauge
from pimper_torch.method.photometry.photometry_config import FitLightConfig


def solved(factorize, seen, **light):
    """Factorize under the light that is fitted, with these settings of it, and set the gauge."""
    return FixGauge()(factorize(seen, FitLight(FitLightConfig(**light))(seen)))
