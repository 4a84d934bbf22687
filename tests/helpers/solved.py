"""Photometry of samples as in a chain: light, factorization and gauge."""

from pimper_torch.stages.photometry.fit_light import FitLight
from pimper_torch.stages.photometry.gauge import FixGauge
from pimper_torch.stages.photometry.photometry_config import FitLightConfig


def solved(factorize, seen, **light):
    """Fit the light with the given settings, factorize, and fix the gauge."""
    return FixGauge()(factorize(seen, FitLight(FitLightConfig(**light))(seen)))
