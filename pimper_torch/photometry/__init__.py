"""Shape from shading under changing light: harmonics, the cone, lights, factorization."""

from pimper_torch.photometry.factorize import Factorize, FactorizeConfig

__all__ = ["Factorize", "FactorizeConfig"]
