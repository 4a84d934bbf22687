"""Baseline: photometric stereo on the whole object at once, one light a view."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.config import Range, require, require_ranges
from pimper_torch.errors import ReconstructionError
from pimper_torch.evidence.baselines.anchoring import (
    apply_bas_relief,
    bas_relief_through,
    look_up,
    points_on,
    rotation_normals,
)
from pimper_torch.evidence.baselines.one_matrix import Whole, as_problem, chunks, solve_whole
from pimper_torch.evidence.baselines.template import (
    Matrix,
    Template,
    fit_colours,
    lay_template,
    on_template,
    register,
    registered_views,
    surface_of,
)
from pimper_torch.geometry.frames import invert_rigid
from pimper_torch.paper.integrate import integrate_normals
from pimper_torch.patches.warp import WarpConfig
from pimper_torch.photometry.balm import solve_balm
from pimper_torch.photometry.bilinear import Factors
from pimper_torch.photometry.cone import split_shading
from pimper_torch.photometry.harmonics import harmonics, rotate_lights
from pimper_torch.photometry.lights import fit_light_field
from pimper_torch.photometry.sample_estimates import initial_shading, refine_on_manifold
from pimper_torch.records import CoarseMesh, Convergence, Estimate, Record, SparseScene
from pimper_torch.records.patches import confidence_of
from pimper_torch.single_view.factorization.ambiguity import align_factorizations
from pimper_torch.single_view.factorization.starts import start_from_data
from pimper_torch.stage import Stage

# Lights are fitted to the mesh, and the ambiguity is fixed, on this many samples.
LIGHT_SAMPLES = 30_000


@dataclass(frozen=True, slots=True, kw_only=True)
class GlobalStereoConfig:
    """Settings of :class:`GlobalStereo`.

    Attributes:
        samples_per_pixel: Samples of the raster per pixel of the reference view.
        start: Where the factorization starts: ``"mesh"``, one light a view fitted to the
            coarse mesh's normals; ``"svd"``, singular vectors of the filled data. Even on
            exact views, registered on facets, the solver ends elsewhere from singular
            vectors (normals of a sphere 8.5 degrees off instead of 0.7), so the mesh is the
            default.
        start_samples: The solver first runs on this many samples, which determine the lights
            nearly as well as all do; the whole matrix goes on from there. 0 leaves it out.
        min_views: Views a sample must be lit in.
        max_iterations: Of each run of the solver.
        tolerance: Relative change at which it is done.
        max_tilt_deg: Normals further from the viewing direction are brought to this angle
            before integration.
        upgrades: How often the Lorentz transformation is fixed again, with the normals of the
            relief that the points corrected.
        integration_steps: Of conjugate gradients, after Frankot and Chellappa's projection.
        warp: Which samples a view may contribute.
    """

    samples_per_pixel: Annotated[float, Range(above=0, most=8)] = 1.0
    start: Literal["mesh", "svd"] = "mesh"
    start_samples: Annotated[int, Range(least=0, most=100_000_000)] = 30_000
    min_views: Annotated[int, Range(least=4, most=100_000)] = 4
    max_iterations: Annotated[int, Range(least=1, most=100_000)] = 200
    tolerance: Annotated[float, Range(above=0, most=1)] = 1e-3
    max_tilt_deg: Annotated[float, Range(above=0, below=90)] = 75.0
    upgrades: Annotated[int, Range(least=0, most=100_000)] = 2
    integration_steps: Annotated[int, Range(least=0, most=100_000)] = 30
    warp: WarpConfig = field(default_factory=lambda: WarpConfig(occlusion_stride=2))

    def __post_init__(self) -> None:
        require_ranges(self)
        require(self.start in ("mesh", "svd"), "start", self.start, "mesh or svd")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class WholePhotometry(Record):
    """The factorization of the whole object, template frame.

    Attributes:
        lights: First order, one a view.
        normals: Unit; the mesh's where not valid.
        albedo: Gray.
        valid: True where the photographs determined the normal.
        information: Inverse variance of the normals; 0 where not valid.
        iterations: Of the solver on the whole matrix.
        converged: Whether it did.
    """

    lights: Float[Tensor, "view 4"]
    normals: Float[Tensor, "sample 3"]
    albedo: Float[Tensor, " sample"]
    valid: Bool[Tensor, " sample"]
    information: Float[Tensor, " sample"]
    iterations: int
    converged: bool


class GlobalStereo(Stage):
    """Global photometric stereo by masked factorization: one matrix, one light a view.

    The published comparison factorizes the whole object, registered on the coarse mesh, as
    one F x K matrix with the published solver (augmented Lagrangian on the photometric
    cone, no robust weights, no prior from the mesh). Here it is the same problem:

    1. a raster over all of the reference view's side of the coarse mesh, all views looked up
       on it with visibility, shadows and saturation masked;
    2. ``min |D (J - L N)|^2`` with ``N`` on the cone, one light a view for the whole object;
    3. the Lorentz transformation that this leaves free, chosen so that the shading vectors
       come nearest to those of the coarse mesh under the lights that fit it;
    4. integration over the whole raster, and the bas-relief transformation and distance that
       bring the relief nearest to the sparse points (the published alignment gives every
       patch that freedom, so the whole object gets it too).

    What limits it: one light for the whole object is wrong under a near point light, and shadows
    and highlights are not weighed; lights that are free to follow such errors do. (On a rendered
    glossy jar under a near point light, normals under lights fitted to the mesh are 11 degrees off
    the truth; while the factorization lowers its residual from 0.060 to 0.054 they go to 22,
    and stay there with the Lorentz transformation that fits the truth best.) All views are
    registered on flat facets and never again; integration runs over depth discontinuities.

    Not differentiable. Peak memory is 5 bytes for every sample and view beside the views.
    """

    def __init__(self, config: GlobalStereoConfig | None = None) -> None:
        super().__init__()
        self.config = config or GlobalStereoConfig()

    @torch.no_grad()
    def forward(self, scene: SparseScene, coarse: CoarseMesh) -> Estimate:
        """Reconstruct what the mesh's reference view sees.

        Returns:
            Normals are photometric where ``min_views`` views determine them, else the
            mesh's, with confidence 0. Lights are those of the factorization.

        Raises:
            ReconstructionError: Fewer than four views, no sample seen by enough of them, or
                fewer than four sparse points on the mesh.
        """
        config, cameras, reference = self.config, scene.cameras, coarse.reference
        refuse_few_views(cameras.num_views, config.min_views, "rank-4 factorization")
        template = lay_template(coarse.mesh, cameras, reference, config.samples_per_pixel)
        points = points_on(template, scene.points_world, coarse)
        matrix = register(template, scene.views, cameras, coarse.mesh, config.warp)
        refuse_little_overlap(matrix, config.min_views)
        whole = solve_from_mesh(matrix, config)
        photometry, depth = self._upgraded(template, matrix, whole, points)
        colours = fit_colours(
            registered_views(template, scene.views, cameras, coarse.mesh, config.warp),
            photometry.lights,
            harmonics(photometry.normals),
        )
        albedo, lights = in_gauge(colours, photometry.lights, photometry.valid)
        confidence = confidence_of(photometry.information)
        mesh = surface_of(template, depth, photometry.normals, albedo, confidence)
        world_from_template = invert_rigid(template.template_from_world)
        return Estimate(
            mesh=mesh,
            names=scene.views.names,
            cameras=cameras,
            lights_world=rotate_lights(world_from_template, lights),
            reference=scene.views.names[reference],
        )

    def _upgraded(
        self,
        template: Template,
        matrix: Matrix,
        whole: Whole,
        points: Float[Tensor, "point 3"],
    ) -> tuple[WholePhotometry, Float[Tensor, "height width"]]:
        """Resolve the ambiguity and integrate; repeat with the normals corrected by the points."""
        config, normals = self.config, matrix.normals
        for last in [False] * config.upgrades + [True]:
            fixed = fix_ambiguity(matrix.replace(normals=normals), whole, config.min_views)
            found = last_step(matrix, fixed, config.min_views)
            steps = config.integration_steps if last else 0
            relief = _integrated(template, found, config.max_tilt_deg, steps)
            through = bas_relief_through(points, look_up(template, relief, points))
            normals = rotation_normals(through, found.normals)
        depth = apply_bas_relief(through, template, relief)
        return found.replace(normals=normals), depth


def solve_from_mesh(matrix: Matrix, config: GlobalStereoConfig) -> Whole:
    """Separate albedo, normals and light of one matrix, up to a Lorentz transformation."""
    steps, some = 0, _well_seen(matrix, config.min_views, LIGHT_SAMPLES)
    lights = fit_distant_lights(some.radiance.mT, some.seen.mT, some.normals)
    if config.start == "svd":
        shading = _best_shading(some, lights)
        lights = start_from_data(some.radiance[None], some.seen[None], lights[None], shading[None])[
            0
        ][0]
    if config.start_samples:
        few = _well_seen(matrix, config.min_views, config.start_samples)
        problem = as_problem(few, lights, _best_shading(few, lights))
        few_solved = solve_balm(problem, config.max_iterations, config.tolerance)
        lights, steps = few_solved.lights[0], int(few_solved.convergence.iterations)
    shading = _best_shading(matrix, lights)
    return solve_whole(matrix, lights, shading, config.max_iterations, config.tolerance, steps)


def fit_distant_lights(
    radiance: Float[Tensor, "sample view"],
    seen: Bool[Tensor, "sample view"],
    normals: Float[Tensor, "sample 3"],
) -> Float[Tensor, "view 4"]:
    """Fit lights that are constant over the scene, as the chain fits its own.

    See :func:`~pimper_torch.photometry.lights.fit_light_field`.

    Returns:
        First-order lights in the frame of the normals, of what faces the point light.
    """
    field = fit_light_field(radiance, seen, normals)
    return field.lights_at(field.origin[None])[0]


def fix_ambiguity(matrix: Matrix, whole: Whole, min_views: int) -> Whole:
    """Align a factorization with given normals by one Lorentz transformation.

    What it should come near to are the shading vectors that the normals have under the lights
    that fit them best.

    Args:
        min_views: Samples that fewer views see are ignored.
    """
    often = matrix.seen.sum(dim=0) >= min_views
    (observed,) = often.nonzero(as_tuple=True)
    few = observed[:: _stride(len(observed), LIGHT_SAMPLES)]
    some = matrix.columns(few)
    lights = fit_distant_lights(some.radiance.mT, some.seen.mT, some.normals)
    move = align_factorizations(
        whole.shading[None, :, few],
        _best_shading(some, lights)[None],
        some.seen.sum(dim=0)[None].to(whole.shading),
    )
    return whole.replace(
        lights=move.on_lights(whole.lights[None])[0],
        shading=move.on_shading(whole.shading[None])[0],
    )


def refuse_few_views(num_views: int, needed: int, what: str) -> None:
    """Refuse scenes with fewer views than unknowns.

    Raises:
        ReconstructionError: Says so.
    """
    if num_views < needed:
        raise ReconstructionError(
            f"{what}: {num_views} views are registered, and at least {needed} are needed, each "
            "under a light of its own. Register more photographs."
        )


def refuse_little_overlap(matrix: Matrix, min_views: int) -> None:
    """Refuse matrices in which hardly any sample is seen in enough views.

    Raises:
        ReconstructionError: Says how often samples are seen.
    """
    often = matrix.seen.sum(dim=0)
    enough = int((often >= min_views).sum())
    if enough < 16:
        raise ReconstructionError(
            f"of {len(often)} samples on the surface {enough} are seen lit in {min_views} views "
            f"or more (the best in {int(often.max())}), and at least 16 are needed. Photograph "
            "the reference view's side again, or check masks and exposure."
        )


def in_gauge(
    albedo: Float[Tensor, "sample channel"],
    lights: Float[Tensor, "view light"],
    valid: Bool[Tensor, " sample"],
) -> tuple[Float[Tensor, "sample channel"], Float[Tensor, "view light"]]:
    """Set the 99th percentile of gray albedo to 1, as the method's own results have it."""
    gray = albedo.mean(dim=1)[valid]
    if len(gray) == 0:
        return albedo, lights
    bright = gray.kthvalue(max(1, math.ceil(0.99 * len(gray)))).values
    factor = torch.where(bright > 0, bright, 1)
    return albedo / factor, lights * factor


def _stride(samples: int, number: int) -> int:
    return max(1, -(-samples // number))


def _well_seen(matrix: Matrix, min_views: int, number: int) -> Matrix:
    """Choose about so many samples, evenly spaced among those that enough views see."""
    (observed,) = (matrix.seen.sum(dim=0) >= min_views).nonzero(as_tuple=True)
    return matrix.columns(observed[:: _stride(len(observed), number)])


def _best_shading(matrix: Matrix, lights: Float[Tensor, "view 4"]) -> Float[Tensor, "4 sample"]:
    """Return shading vectors with the matrix's normals and the albedo that fits them best."""
    parts = []
    for part in chunks(matrix.seen.shape[1]):
        some = matrix.columns(part)
        shading = initial_shading(
            some.radiance[None], some.seen[None], lights[None], harmonics(some.normals).mT[None]
        )
        parts.append(shading[0])
    return torch.cat(parts, dim=1)


def last_step(matrix: Matrix, whole: Whole, min_views: int) -> WholePhotometry:
    """Return every sample's minimum, and the inverse variance of its normal."""
    lit = matrix.seen.sum(dim=0) >= min_views
    none = torch.zeros(1, dtype=torch.long, device=lit.device)
    convergence = Convergence(iterations=none, residual=none.to(whole.lights), cause=none)
    albedo, normals, information = [], [], []
    for part in chunks(len(lit)):
        problem = as_problem(matrix.columns(part), whole.lights, whole.shading[:, part])
        factors = Factors(
            lights=problem.lights,
            shading=problem.shading,
            weight=problem.weight,
            convergence=convergence,
        )
        found = refine_on_manifold(problem, factors)
        albedo.append(found.albedo[0])
        normals.append(found.normals[0])
        information.append(found.information[0])
    photometric, gray = torch.cat(normals), torch.cat(albedo)
    finite = photometric.isfinite().all(dim=1) & (gray > 0) & (photometric[:, 2] < 0)
    valid = lit & finite
    return WholePhotometry(
        lights=whole.lights,
        normals=torch.where(valid[:, None], photometric, matrix.normals),
        albedo=torch.where(valid, gray, split_shading(whole.shading.mT)[0].nan_to_num()),
        valid=valid,
        information=torch.cat(information) * valid,
        iterations=whole.iterations,
        converged=whole.converged,
    )


def _integrated(
    template: Template, found: WholePhotometry, max_tilt_deg: float, steps: int
) -> Float[Tensor, "height width"]:
    return integrate_normals(
        on_template(found.normals, template.inside)[None],
        on_template(found.valid, template.inside)[None],
        on_template(found.information, template.inside)[None],
        template.spacing[None],
        math.tan(math.radians(max_tilt_deg)),
        steps,
    )[0]
