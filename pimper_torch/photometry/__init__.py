"""Shape from shading under changing light: harmonics, the cone, lights, factorization.

The factorization works alone: pose a :class:`Bilinear` problem, or a low-rank one by
:func:`low_rank_problem`, and hand it to a solver.
"""

from pimper_torch.photometry.alternation import solve_alternation
from pimper_torch.photometry.balm import solve_balm
from pimper_torch.photometry.bilinear import Bilinear, Factors, Solver
from pimper_torch.photometry.colour import ColourFactors, solve_in_colour
from pimper_torch.photometry.descent import solve_descent
from pimper_torch.photometry.factorize import Factorize, FactorizeConfig, Illumination
from pimper_torch.photometry.implicit import differentiable
from pimper_torch.photometry.low_rank import low_rank_problem, random_left, singular_left
from pimper_torch.photometry.manifolds import Cone, Free, SecondOrder
from pimper_torch.photometry.mesh_light import thinned
from pimper_torch.photometry.restarts import Restarted, factorize_from_many
from pimper_torch.photometry.robust import Cauchy, Squares
from pimper_torch.photometry.variable_projection import solve_variable_projection

__all__ = [
    "Bilinear",
    "Cauchy",
    "ColourFactors",
    "Cone",
    "Factorize",
    "FactorizeConfig",
    "Factors",
    "Free",
    "Illumination",
    "Restarted",
    "SecondOrder",
    "Solver",
    "Squares",
    "differentiable",
    "factorize_from_many",
    "low_rank_problem",
    "random_left",
    "singular_left",
    "solve_alternation",
    "solve_balm",
    "solve_descent",
    "solve_in_colour",
    "solve_variable_projection",
    "thinned",
]
