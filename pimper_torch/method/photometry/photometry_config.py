"""Settings of the light's fit and of the factorization."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from pimper_torch.runtime.config import Range, require, require_ranges

_Model = Literal["auto", "soft", "point_light", "room"]
_Solver = Literal["variable-projection", "balm"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FitLightConfig:
    """Settings of :class:`FitLight`.

    The published method is ``model="soft"``, ``colours=False`` and ``shadows=False``.

    Attributes:
        model: ``"soft"``, first-order harmonics per view, constant over the scene;
            ``"point_light"``, ambient light and a near point light with attached shadows;
            ``"room"``, a near point light in a room that is lit, whose light is second-order
            harmonics shared by the views up to exposure; ``"auto"``, the simplest that predicts
            radiance left out of the fit.
        colours: Whether views may have light of unlike colour, where that predicts radiance left
            out of the fit, and be exposed unlike by 1.5 stops or more.
        shadows: Whether the surface casts shadows, whose samples the factorization leaves out.
            Needs a surface that is nearly right.
        min_views: Views a sample must be seen in.
    """

    model: _Model = "auto"
    colours: bool = True
    shadows: bool = True
    min_views: Annotated[int, Range(least=3, most=100_000)] = 4

    def __post_init__(self) -> None:
        require_ranges(self, "light")
        models = get_args(_Model)
        require(self.model in models, "light.model", self.model, " or ".join(models))


@dataclass(frozen=True, slots=True, kw_only=True)
class FactorizeConfig:
    """Settings of :class:`Factorize`.

    The published method is ``solver="balm"``, ``loss="squares"``, and no priors: ``light_prior=0``
    and ``geometry_weight=0``.

    Attributes:
        solver: ``"variable-projection"``, damped Gauss-Newton on the lights with shading
            eliminated; ``"balm"``, augmented Lagrangian.
        light_prior: Weight of the prior of each patch's lights, whose mean is the light field, in
            units of the patch's own data; 0 leaves them free, 1e6 fixes them.
        geometry_weight: Weight of the prior of normals, whose mean is the coarse ones, in units
            of one view.
        loss: ``"cauchy"``, by which highlights and shadows lose weight; ``"geman-mcclure"``, by
            which they lose it faster; ``"huber"``, more slowly; ``"squares"``; or another name in
            :data:`~pimper_torch.method.photometry.factorize.LOSSES`.
        loss_scale: Of the loss, in standard deviations of the patch's residuals; 0 for that at
            which it is 95 % efficient on Gaussian noise.
        min_views: Views a sample must be lit in; its unknowns are albedo and two angles,
            and the lights take their share.
        min_light_variation: Minimum third singular value of a patch's lights, over the first;
            about the smaller extent, in radians, of the light's directions.
        max_iterations: Of the solver.
        tolerance: Relative change at which a patch has converged: of its objective with variable
            projection, of its shading vectors with BALM.
    """

    solver: _Solver = "variable-projection"
    light_prior: Annotated[float, Range(least=0, most=1e12)] = 1.0
    geometry_weight: Annotated[float, Range(least=0, most=1e12)] = 0.1
    loss: str = "cauchy"
    loss_scale: Annotated[float, Range(least=0, most=1e12)] = 0.0
    min_views: Annotated[int, Range(least=3, most=100_000)] = 4
    min_light_variation: Annotated[float, Range(least=0, below=1)] = 0.02
    max_iterations: Annotated[int, Range(least=1, most=100_000)] = 60
    tolerance: Annotated[float, Range(above=0, most=1)] = 1e-3

    def __post_init__(self) -> None:
        require_ranges(self, "factorize")
        solvers = get_args(_Solver)
        require(self.solver in solvers, "factorize.solver", self.solver, " or ".join(solvers))
