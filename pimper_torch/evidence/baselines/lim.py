"""Baseline: Lim, Ho, Yang and Kriegman's passive photometric stereo from motion."""

import math
from dataclasses import dataclass, field
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.config import Range, require, require_ranges
from pimper_torch.evidence.baselines.anchoring import (
    apply_bas_relief,
    bas_relief_through,
    look_up,
    points_on,
)
from pimper_torch.evidence.baselines.global_stereo import (
    fit_distant_lights,
    in_gauge,
    refuse_few_views,
    refuse_little_overlap,
)
from pimper_torch.evidence.baselines.rank_three import (
    Rank3,
    Spans,
    ambiguity_between_points,
    factorize_rank_three,
    matrix_between_lights,
    solve_vectors,
)
from pimper_torch.evidence.baselines.template import (
    Matrix,
    Template,
    fit_colours,
    lay_template,
    on_template,
    raster_faces,
    register,
    registered_views,
    surface_of,
)
from pimper_torch.geometry.height_fields import sample_raster
from pimper_torch.geometry.topology import face_edges
from pimper_torch.paper.fill import delaunay
from pimper_torch.paper.integrate import integrate_normals
from pimper_torch.patches.warp import WarpConfig
from pimper_torch.records import CoarseMesh, Estimate, Mesh, Record, SparseScene
from pimper_torch.stage import Stage

# Spacing of the vertices of the surface that occludes samples, in samples: a choice.
OCCLUDER_STRIDE = 4

# Points along an edge at which slopes are sampled: a choice.
EDGE_POINTS = 24


@dataclass(frozen=True, slots=True, kw_only=True)
class LimConfig:
    """Settings of :class:`Lim`.

    Attributes:
        samples_per_pixel: Of each round, coarse to fine: samples of the raster per pixel of
            the reference view.
        light_samples: The lights are factorized from this many samples, which determine them as
            well as all do; every sample's vector then follows from all its views.
        min_views: Views a sample must be seen in.
        alternations: Of the masked factorization, at most.
        max_tilt_deg: Normals further from the viewing direction are brought to this angle
            before integration.
        integration_steps: Of conjugate gradients, after Frankot and Chellappa's projection.
        warp: Which samples a view may contribute.
    """

    samples_per_pixel: tuple[float, ...] = (0.25, 0.25, 0.5, 0.5, 1.0)
    light_samples: Annotated[int, Range(least=16, most=100_000_000)] = 40_000
    min_views: Annotated[int, Range(least=3, most=100_000)] = 4
    alternations: Annotated[int, Range(least=1, most=100_000)] = 100
    max_tilt_deg: Annotated[float, Range(above=0, below=90)] = 75.0
    integration_steps: Annotated[int, Range(least=0, most=100_000)] = 30
    warp: WarpConfig = field(default_factory=lambda: WarpConfig(occlusion_stride=2))

    def __post_init__(self) -> None:
        require_ranges(self)
        scales = self.samples_per_pixel
        within = len(scales) > 0 and all(0 < scale <= 8 for scale in scales)
        require(within, "samples_per_pixel", scales, "above 0, at most 8 each")


class Lim(Stage):
    """Alternate registration of views by the surface and photometric stereo on them.

    An iteration registers all views on the current surface (first the facets through the sparse
    points), factorizes what it sees under one distant point light a view (rank three: no ambient
    light), finds the factors' 3 x 3 ambiguity, integrates the normals, and takes the relief
    for the next surface. The depths of the sparse points fix the ambiguity, and the distance.

    Where the paper leaves room, this is our reading:

    - the surface is a relief over the reference view, orthographic along the line of sight to
      its centre, with one vertex a sample, instead of facets of a triangulation;
    - views contribute where the surface's visibility test, dark and saturation levels and a
      limit of tilt let them (the published short baselines need none of it), and the factors
      are fitted to these by alternating least squares; samples seen too seldom are filled in
      smoothly from those around them;
    - the ambiguity is the matrix under which slopes lead from each sparse point to its
      neighbours in a triangulation; published are integrability sample by sample, which leaves
      a bas-relief transformation, and depths for that (see
      :mod:`.rank_three` for why); it is sought from where the lights
      are nearest to those that fit the present surface;
    - integration is a weighted Poisson problem in the cosine basis, not gradient descent;
    - what the points add after integration, a bas-relief transformation and the
      distance, is fitted robustly (Cauchy's loss), as points of
      real clouds may be wrong;
    - iterations go from a quarter of the resolution to the whole.

    What limits it: ambient light, a near point light and interreflection are no rank-three matrix;
    cast shadows and highlights are not foreseen; integration runs over depth discontinuities.

    Not differentiable. Peak memory is 5 bytes for every sample and view beside the views.

    Source: Lim, Ho, Yang & Kriegman, Passive photometric stereo from motion, ICCV 2005.
    """

    def __init__(self, config: LimConfig | None = None) -> None:
        super().__init__()
        self.config = config or LimConfig()

    @torch.no_grad()
    def forward(self, scene: SparseScene, coarse: CoarseMesh) -> Estimate:
        """Reconstruct what the mesh's reference view sees.

        Returns:
            Lights have no ambient part, by assumption. Where too few views see a sample its
            normal is that of the relief, and its confidence 0; else it is 1.

        Raises:
            ReconstructionError: Fewer than three views, no sample seen by enough of them, or
                fewer than four sparse points on the mesh.
        """
        config, reference = self.config, coarse.reference
        refuse_few_views(scene.cameras.num_views, config.min_views, "rank-3 factorization")
        found: Round | None = None
        for scale in config.samples_per_pixel:
            template = lay_template(coarse.mesh, scene.cameras, reference, scale)
            points = points_on(template, scene.points_world, coarse)
            occluder = coarse.mesh
            if found is not None:
                template = transferred(found, template)
                occluder = thinned(template)
            seen = (template, scene.views, scene.cameras, occluder, config.warp)
            matrix = register(*seen)
            refuse_little_overlap(matrix, config.min_views)
            found = relief_from(matrix, template, points, config)
        assert found is not None, "no rounds"
        colours = fit_colours(registered_views(*seen), found.lights, found.normals)
        albedo, lights = in_gauge(colours, found.lights, found.valid)
        world = lights @ template.template_from_world[:3, :3].to(lights)
        return Estimate(
            mesh=surface_of(
                template, found.depth, found.normals, albedo, found.valid.to(found.depth)
            ),
            names=scene.views.names,
            cameras=scene.cameras,
            lights_world=torch.cat([torch.zeros_like(world[:, :1]), world], dim=1),
            reference=scene.views.names[reference],
        )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Round(Record):
    """The result of one iteration, template frame.

    Attributes:
        template: What it started from.
        depth: Of the new surface.
        normals: Unit, of the samples inside; those of the relief where not valid.
        valid: True where enough views see the sample.
        lights: Directions times strength, one a view.
    """

    template: Template
    depth: Float[Tensor, "height width"]
    normals: Float[Tensor, "sample 3"]
    valid: Bool[Tensor, " sample"]
    lights: Float[Tensor, "view 3"]


def relief_from(
    matrix: Matrix,
    template: Template,
    points: Float[Tensor, "point 3"],
    config: LimConfig,
) -> Round:
    """Factorize, resolve the ambiguity by integrability and points, and integrate."""
    often = matrix.seen.sum(dim=0) >= config.min_views
    (observed,) = often.nonzero(as_tuple=True)
    some = matrix.columns(observed[:: max(1, -(-len(observed) // config.light_samples))])
    lights = factorize_rank_three(some.radiance, some.seen, config.alternations)
    factors = Rank3(lights=lights, vectors=solve_vectors(matrix.radiance, matrix.seen, lights))
    spans = spans_between(edges_of(points), template, factors, often)
    surface_lights = fit_distant_lights(some.radiance.mT, some.seen.mT, some.normals)
    start = matrix_between_lights(lights, surface_lights[:, 1:])
    factors = facing(factors.moved(ambiguity_between_points(spans, start)), often)
    relief = _integrated(template, factors, often, config)
    through = bas_relief_through(points, look_up(template, relief, points))
    factors = factors.moved(bas_relief_matrix(through))
    # The slopes' limit does not commute with the transformation: integrate what it gives.
    relief = _integrated(template, factors, often, config)
    last = bas_relief_through(points, look_up(template, relief, points))
    factors = facing(factors.moved(bas_relief_matrix(last)), often)
    depth = apply_bas_relief(last, template, relief)
    valid = often & (factors.vectors[2] < 0)
    normals = torch.where(
        valid[:, None],
        normalize(factors.vectors.mT, dim=1),
        relief_normals(depth, template)[template.inside],
    )
    return Round(
        template=template, depth=depth, normals=normals, valid=valid, lights=factors.lights
    )


def edges_of(points: Float[Tensor, "point 3"]) -> Float[Tensor, "span 2 3"]:
    """Return the ends of the edges of a triangulation of the points' x and y."""
    edges, _ = face_edges(delaunay(points[:, :2]))
    return points[edges]


def spans_between(
    edges: Float[Tensor, "span 2 3"],
    template: Template,
    factors: Rank3,
    often: Bool[Tensor, " sample"],
) -> Spans:
    """Sample the factors along the edges, template frame."""
    start, end = edges.unbind(dim=1)
    along = (torch.arange(EDGE_POINTS, device=edges.device).to(edges) + 0.5) / EDGE_POINTS
    positions = start[:, None] + along[:, None] * (end - start)[:, None]
    where = positions.reshape(1, -1, 3)[..., :2]
    raster = (template.origin[None], template.spacing[None])
    inside = on_template(often, template.inside)
    layers = on_template(factors.vectors.mT, template.inside)
    found = sample_raster(layers.movedim(-1, 0)[None], where, *raster, valid=inside[None])
    known = sample_raster(inside[None, None].to(layers), where, *raster)[0, 0] > 0.5
    return Spans(
        step=end - start,
        vectors=found[0].mT.reshape(positions.shape),
        valid=known.reshape(positions.shape[:2]),
    )


def bas_relief_matrix(bas_relief: Float[Tensor, " 4"]) -> Float[Tensor, "3 3"]:
    """Return what ``z' = mu x + nu y + lambda z`` does to albedo times normal."""
    mu, nu, scale, _ = bas_relief.tolist()
    return bas_relief.new_tensor([[scale, 0, -mu], [0, scale, -nu], [0, 0, 1]])


def facing(factors: Rank3, often: Bool[Tensor, " sample"]) -> Rank3:
    """Negate all vectors if most of them face away from the viewer."""
    away = (factors.vectors[2, often] > 0).sum() > (factors.vectors[2, often] < 0).sum()
    sign = -1.0 if away else 1.0
    return Rank3(lights=sign * factors.lights, vectors=sign * factors.vectors)


def transferred(found: Round, template: Template) -> Template:
    """Resample a height field on the raster of the next iteration, of the same frame."""
    positions = template.points(template.depth).reshape(-1, 3)
    depth = look_up(found.template, found.depth, positions).reshape(template.depth.shape)
    normals = relief_normals(depth, template) * template.inside[..., None]
    return template.replace(depth=depth, normals=normals)


def thinned(template: Template) -> Mesh:
    """Triangulate a height field coarsely, to test occlusion."""
    s = slice(OCCLUDER_STRIDE // 2, None, OCCLUDER_STRIDE)
    inside, depth = template.inside[s, s], template.depth[s, s]
    cliff = float(4 * OCCLUDER_STRIDE * template.spacing)
    rows = template.points(template.depth)[s, s][inside]
    return Mesh(vertices_world=template.to_world(rows), faces=raster_faces(inside, depth, cliff))


def relief_normals(
    depth: Float[Tensor, "height width"], template: Template
) -> Float[Tensor, "height width 3"]:
    """Return the viewer-facing normals of a height field by central differences."""
    down, right = torch.gradient(depth, spacing=float(template.spacing))
    return normalize(torch.stack([right, down, -torch.ones_like(depth)], dim=-1), dim=-1)


def _integrated(
    template: Template, factors: Rank3, often: Bool[Tensor, " sample"], config: LimConfig
) -> Float[Tensor, "height width"]:
    normals = normalize(factors.vectors.mT, dim=1)
    valid = often & (normals[:, 2] < 0)
    raster = on_template(valid, template.inside)[None]
    return integrate_normals(
        on_template(normals, template.inside)[None],
        raster,
        raster.to(normals),
        template.spacing[None],
        math.tan(math.radians(config.max_tilt_deg)),
        config.integration_steps,
    )[0]
