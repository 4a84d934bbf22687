"""Shape from shading under changing light: harmonics, the cone, lights, factorization.

The factorization works alone: pose a :class:`Bilinear` problem and hand it to a solver. Other
manifolds and solvers are in :mod:`pimper_torch.single_view.factorization`.
"""

from pimper_torch.ground.linalg.robust import Cauchy, GemanMcClure, Huber, Loss, Squares
from pimper_torch.method.photometry.balm import solve_balm
from pimper_torch.method.photometry.bilinear import Bilinear, Factors, Solver
from pimper_torch.method.photometry.cone import Cone
from pimper_torch.method.photometry.factor_gradients import differentiable
from pimper_torch.method.photometry.factorize import Factorize, FactorizeConfig
from pimper_torch.method.photometry.fit_light import FitLight, FitLightConfig, Illumination
from pimper_torch.method.photometry.gauge import FixGauge
from pimper_torch.method.photometry.lights import thinned
from pimper_torch.method.photometry.variable_projection import solve_variable_projection

__all__ = [
    "Bilinear",
    "Cauchy",
    "Cone",
    "Factorize",
    "FactorizeConfig",
    "Factors",
    "FitLight",
    "FitLightConfig",
    "FixGauge",
    "GemanMcClure",
    "Huber",
    "Illumination",
    "Loss",
    "Solver",
    "Squares",
    "differentiable",
    "solve_balm",
    "solve_variable_projection",
    "thinned",
]
