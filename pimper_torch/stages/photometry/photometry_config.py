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
            ``"room"``, a near point light in a lit room, whose light is second-order harmonics
            shared by the views up to exposure; ``"auto"``, the simplest model that predicts
            held-out radiance.
        colours: Whether views may differ in the colour of their light, if that predicts held-out
            radiance better, and in exposure by 1.5 stops or more.
        shadows: Whether the surface casts shadows, whose samples the factorization excludes.
            Requires a nearly correct surface.
        min_views: Number of views a sample must be seen in.
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
            units of the patch's data; 0 leaves them free, 1e6 fixes them.
        geometry_weight: Weight of the prior of normals, whose mean is the coarse normals, in units
            of one view.
        loss: ``"cauchy"`` downweights highlights and shadows, ``"geman-mcclure"`` more strongly,
            ``"huber"`` less; ``"squares"`` does not. Other names can be added to
            :data:`~pimper_torch.stages.photometry.factorize.LOSSES`.
        loss_scale: Scale of the loss, in standard deviations of the patch's residuals; 0 for the
            scale of 95 % efficiency on Gaussian noise.
        min_views: Number of views a sample must be lit in. Its unknowns are albedo and two angles,
            and the lights use up further degrees of freedom.
        min_light_variation: Minimum third singular value of a patch's lights, over the first;
            about the smaller extent, in radians, of the light's directions.
        max_iterations: Maximum number of iterations of the solver.
        tolerance: Relative change at which a patch has converged: of its objective for variable
            projection, of its shading vectors for BALM.
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
