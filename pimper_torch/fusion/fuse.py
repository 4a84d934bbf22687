"""The stage that makes one surface of slopes, swept heights and the cloud's points."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize

from pimper_torch.config import require
from pimper_torch.fusion.bands import coarse_part
from pimper_torch.fusion.contacts import Ground, cloud_points, rim_tangents
from pimper_torch.fusion.continuation import about_mean, continued, enclosed
from pimper_torch.fusion.drift import MEDIAN_OF_TILT, common_height, drift
from pimper_torch.fusion.estimate import Fused, fuse_evidence
from pimper_torch.fusion.evidence import (
    Common,
    Evidence,
    kept_slopes,
    kept_steps,
    slopes,
    swept_heights,
    upright,
)
from pimper_torch.fusion.expected_error import expected_error
from pimper_torch.fusion.photometry import check_photometry
from pimper_torch.fusion.union import Union, ray_directions, unite, vertex_spacing
from pimper_torch.geometry.lattice import Lattice, subdivide
from pimper_torch.geometry.surfaces import face_edges, vertex_normals
from pimper_torch.photometry.certainty import HALF_CONFIDENCE_DEG
from pimper_torch.records import (
    Convergence,
    DepthPatches,
    Depths,
    Record,
    StopCause,
    Surface,
    SweptPatches,
)
from pimper_torch.rims.constraints import Rims

# Information that every vertex holds to where it is by, in units of one over its spacing
# squared: as if it were known to 100 spacings. It decides where nothing else does.
_HOLD = 1e-4

# Points of the cloud further off the surface than this, in its spacings, are not of it.
_REACH = 20.0

# A turn from vertex to vertex that is larger, in radians, is a fold's.
_FOLD = 0.25

# Squared turn from vertex to vertex that even flat facets are said to have, radians; and the
# least variance of the slopes that a surface has already.
_LEAST_TURN, _LEAST_DOUBT = 1e-8, 1e-6

# Between its vertices the surface is flat: points tell no more than this share of a spacing.
_FINEST = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class FuseConfig:
    """Which evidence takes part, and how the noise of each is found.

    Attributes:
        samples_per_vertex: Template samples between neighbouring vertices of the surface.
            Time and memory fall with its square.
        slopes: Whether normals take part.
        heights: Whether swept heights do.
        points: Whether the cloud's points do.
        rims: Whether the rays through the outlines do.
        drift_rounds: How often the tilt that all normals of a facet share, and the height that
            all swept heights of a facet are off by, are estimated, and the tilt taken out; 0
            trusts both at all wavelengths.
        noise_rounds: Solves in which the noise of each kind of evidence is estimated and
            outliers lose weight, for each estimate of the tilt and twice after them.
        outlier_samples: How far, in samples, a patch may lie from the others before they
            outvote it, where three or more meet.
        error_draws: Of noise, for the expected error of every vertex; the more, the less it is
            off by chance: 8 by a quarter. 0 gives none.
    """

    samples_per_vertex: float = 1.0
    slopes: bool = True
    heights: bool = True
    points: bool = True
    rims: bool = True
    drift_rounds: int = 2
    noise_rounds: int = 3
    outlier_samples: float = 4.0
    error_draws: int = 8

    def __post_init__(self) -> None:
        for name in ("samples_per_vertex", "outlier_samples"):
            require(getattr(self, name) > 0, f"fuse.{name}", getattr(self, name), "above 0")
        require(self.drift_rounds >= 0, "fuse.drift_rounds", self.drift_rounds, "0 or more")
        require(self.error_draws >= 0, "fuse.error_draws", self.error_draws, "0 or more")
        require(self.noise_rounds >= 1, "fuse.noise_rounds", self.noise_rounds, "1 or more")
        some = self.slopes or self.heights or self.points or self.rims
        require(some, "fuse.slopes", self.slopes, "true unless heights or points are")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Task(Record):
    """The lattice, and what the patches together say at its vertices.

    Attributes:
        lattice: The facets, subdivided.
        facets: The coarse mesh's faces.
        directions: Along which heights count.
        union: What the patches say.
        places: Of the vertices on what the templates carry.
        shape: The normals of that.
        edges: Of the lattice.
        spacing: Of its vertices, scene units.
        correlated: Vertices in a window of the sweep.
    """

    lattice: Lattice
    facets: Int[Tensor, "facet 3"]
    directions: Float[Tensor, "vertex 3"]
    union: Union
    places: Float[Tensor, "vertex 3"]
    shape: Float[Tensor, "vertex 3"]
    edges: Int[Tensor, "edge 2"]
    spacing: Float[Tensor, ""]
    correlated: float


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Solved(Record):
    """The heights, and the systems that they are from.

    Attributes:
        heights: Detail of the one, coarse shape of the other; float64.
        fine: That detail is from.
        coarse: That the coarse shape is from.
        solves: There were.
    """

    heights: Float[Tensor, " vertex"]
    fine: Fused
    coarse: Fused
    solves: int


class Fuse(nn.Module):
    """Solve for the surface that all evidence suits best, over the whole connected lattice.

    Unknown is the height of every lattice vertex along the coarse mesh's smoothed normal.
    Evidence is linear in it: edges are at right angles to photometric normals, the sweep knows
    heights, the cloud's points lie on the surface, rays through the outlines touch it, and where
    no light tells anything the surface keeps the slopes it has, or continues those of lit ground
    that encloses it (:mod:`~pimper_torch.fusion.continuation`). Across contours and folds, as seen
    along the directions, no normal can be followed, and heights go on differing as they do. Each
    kind comes with the variances that its source claims; what these must be multiplied by is
    estimated from the residuals (:mod:`~pimper_torch.fusion.estimate`). Normals of one facet err
    alike, as they were found under one light: the tilt they share is estimated from the positions
    and taken out. So do swept heights: what they are off by together is estimated from the other
    kinds, and they count for no more than that lets them know
    (:mod:`~pimper_torch.fusion.drift`). Detail is that of normals trusted singly, the coarse shape
    that of normals known to err alike (:mod:`~pimper_torch.fusion.bands`).

    The surface's normals are its own; its albedo is continued over what no light tells,
    without confidence. Differentiable in templates, normals, albedo, confidence, swept heights
    and the cloud, through every solve; which patches, samples, edges, vertices and faces take part
    is constant.
    """

    def __init__(self, config: FuseConfig | None = None) -> None:
        super().__init__()
        self.config = config or FuseConfig()

    def forward(self, swept: SweptPatches, rims: Rims | None = None) -> Surface:
        """Fuse what is known of all patches.

        Args:
            swept: Photometry and swept heights of all patches.
            rims: What outlines say about the surface; ``None`` without outlines.

        The convergence's residual is the root mean square distance that the surface moved, in
        scene units; its iterations are the solves.

        Raises:
            InputError: As :func:`~pimper_torch.fusion.photometry.check_photometry`.
        """
        check_photometry(swept.photometric)
        config, patches = self.config, swept.patches
        facets = patches.coarse.mesh.faces
        spacing = vertex_spacing(patches, config.samples_per_vertex)
        lattice = subdivide(patches.coarse.mesh.vertices_world, facets, spacing)
        directions = ray_directions(lattice, patches.coarse)
        union = unite(
            carried_reliefs(swept), lattice, directions, config.outlier_samples, swept.buckets
        )
        places = lattice.points + union.heights[:, None] * directions
        task = _Task(
            lattice=lattice,
            facets=facets,
            directions=directions,
            union=union,
            places=places,
            shape=vertex_normals(places, lattice.faces),
            edges=face_edges(lattice.faces)[0],
            spacing=spacing.median(),
            correlated=swept.averaged / config.samples_per_vertex**2,
        )
        solved = self._solved(task, self._points(task, swept, rims))
        heights = solved.heights.to(union.heights)
        vertices = lattice.points + heights[:, None] * directions
        normals = vertex_normals(vertices, lattice.faces)
        moved = (heights - union.heights).detach()
        return Surface(
            vertices_world=vertices,
            faces=lattice.faces,
            facet=lattice.facet,
            barycentric=lattice.barycentric,
            normals_world=normals,
            albedo=about_mean(union.albedo, union.seen, task.edges),
            confidence=union.confidence,
            expected_error=self._expected_error(task, solved, normals),
            convergence=Convergence(
                iterations=torch.full((1,), solved.solves, device=moved.device),
                residual=moved.square().mean().sqrt()[None],
                cause=torch.full((1,), int(StopCause.CONVERGED), device=moved.device),
            ),
        )

    def _expected_error(
        self, task: _Task, solved: _Solved, normals: Float[Tensor, "vertex 3"]
    ) -> Float[Tensor, " vertex"] | None:
        """Give the expected error across the surface; heights count along directions."""
        if self.config.error_draws == 0:
            return None
        along = expected_error(
            solved.fine, solved.coarse, task.lattice, task.facets, self.config.error_draws
        )
        facing = (normals.detach() * task.directions.detach()).sum(dim=-1).abs()
        return torch.hypot(along.to(facing) * facing, _FINEST * task.spacing.detach())

    def _heights(self, task: _Task, common: Common | None = None) -> list[Evidence]:
        """List what the sweep knows."""
        if not self.config.heights:
            return []
        union = task.union
        facing = (task.shape * task.directions).sum(dim=-1)
        told = union.heights, union.offsets, union.information, facing
        return [swept_heights(*told, task.correlated, common)]

    def _points(self, task: _Task, swept: SweptPatches, rims: Rims | None) -> list[Evidence]:
        """List the places that the surface passes through: the cloud's points, and rims."""
        ground = Ground(
            places=task.places,
            faces=task.lattice.faces,
            heights=task.union.heights,
            directions=task.directions,
            reach=float(_REACH * task.spacing.detach()),
            finest=_FINEST * task.spacing,
        )
        found = []
        cloud = swept.patches.coarse.points
        if self.config.points and cloud is not None:
            found.append(cloud_points(cloud, ground))
        if self.config.rims and rims is not None:
            found.append(rim_tangents(rims.touching(task.places, task.shape), ground))
        return found

    def _solved(self, task: _Task, points: list[Evidence]) -> _Solved:
        config, union = self.config, task.union
        variance = _variance(union.confidence)
        known = union.seen & (union.confidence > 0)
        if not config.slopes:
            known = torch.zeros_like(known)
        flat, along = task.lattice.points, task.directions
        lit = known[task.edges].all(dim=1) & upright(task.edges, along, union.normals_world)
        straight = task.edges[lit]
        unlit = self._unlit(task, known, lit)
        hold = (_HOLD / task.spacing**2).expand_as(union.heights)

        def solve(
            normals: Float[Tensor, "vertex 3"], positions: list[Evidence], common: Common | None
        ) -> Fused:
            found = slopes(straight, flat, along, normals, variance, common)
            kinds = [*unlit, *positions, found]
            return fuse_evidence(kinds, union.heights, hold, config.noise_rounds)

        normals, solves = union.normals_world, config.noise_rounds
        heights = self._heights(task)
        if config.drift_rounds == 0 or not bool(lit.any()) or not (heights or points):
            only = solve(normals, [*points, *heights], None)
            return _Solved(heights=only.heights, fine=only, coarse=only, solves=solves)
        shape = task.shape
        # Heights are judged by the others first, which they would draw along.
        positions = points or heights
        for _ in range(config.drift_rounds):
            apart = drift(task.lattice, task.facets, normals, shape, known)
            fused = solve(normals, positions, apart.common(task.lattice))
            moved = fused.heights.to(flat)
            shape = vertex_normals(flat + moved[:, None] * along, task.lattice.faces)
            solves += config.noise_rounds
            if points and heights:
                positions = [*points, *self._judged(task, heights, points, fused)]
        apart = drift(task.lattice, task.facets, normals, shape, known)
        normals = normalize(normals + apart.at(task.lattice, task.facets), dim=-1)
        fine = solve(normals, positions, None)
        left = drift(task.lattice, task.facets, normals, shape, known)
        coarse = solve(normals, positions, left.common(task.lattice))
        shift = coarse_part(coarse.heights - fine.heights, task.lattice, task.facets)
        return _Solved(
            heights=fine.heights + shift,
            fine=fine,
            coarse=coarse,
            solves=solves + config.noise_rounds,
        )

    def _judged(
        self, task: _Task, heights: list[Evidence], points: list[Evidence], fused: Fused
    ) -> list[Evidence]:
        """List what the sweep knows, knowing what its heights are off by together."""
        facet = task.lattice.facet
        held = facet[torch.cat([kind.unknowns[:, 0] for kind in points])]
        common = common_height(heights[0], fused.heights, facet, held)
        return self._heights(task, common)

    def _unlit(
        self, task: _Task, known: Bool[Tensor, " vertex"], lit: Bool[Tensor, " edge"]
    ) -> list[Evidence]:
        """List the slopes where light tells nothing; no residual tells their variances.

        Where lit ground encloses it, its normals are continued: the shape there is what the
        facets started with, since no round knew it. Elsewhere the shape is kept. Continued normals
        of a facet are off alike: together they tell as much as one of them.
        """
        flat, along, edges = task.lattice.points, task.directions, task.edges
        carried, doubt = task.union.heights, self._doubt(task, known)
        alike = doubt * torch.bincount(task.lattice.facet)[task.lattice.facet].to(task.shape)
        island = enclosed(known, task.lattice.faces)
        normals = task.union.normals_world
        if bool(island.any()):
            hold = _turn(task.shape, edges[lit]) / alike
            normals = normalize(continued(normals, ~island, edges, task.shape, hold), dim=-1)
        over = island[edges].any(dim=1) & upright(edges, along, normals)
        stays = ~lit & ~over
        sloped = stays & upright(edges, along, task.shape)
        return [
            slopes(edges[over], flat, along, normals, alike).replace(
                correlated=(alike / doubt)[edges[over]].mean(dim=1), judged=False
            ),
            kept_slopes(edges[sloped], flat, along, task.shape, carried, doubt),
            kept_steps(edges[stays & ~sloped], flat, carried, doubt),
        ]

    def _doubt(self, task: _Task, known: Bool[Tensor, " vertex"]) -> Float[Tensor, ""]:
        """Estimate the variance of the slopes that the surface has already, from the others."""
        if not bool(known.any()):
            return task.shape.new_tensor(math.radians(HALF_CONFIDENCE_DEG) ** 2)
        apart = (task.union.normals_world - task.shape)[known].square().sum(dim=-1)
        return (apart.median() / MEDIAN_OF_TILT).clamp_min(_LEAST_DOUBT)


def carried_reliefs(swept: SweptPatches) -> DepthPatches:
    """Take what the templates carry as their relief."""
    return DepthPatches(
        photometric=swept.photometric,
        buckets=tuple(
            Depths(
                depth=templates.depth,
                valid=templates.inside,
                transform=templates.depth.new_tensor([0, 0, 1, 0]).expand(len(templates.facet), 4),
            )
            for templates in swept.patches.buckets
        ),
    )


def _turn(normals: Float[Tensor, "vertex 3"], edges: Int[Tensor, "edge 2"]) -> Float[Tensor, ""]:
    """Give the mean squared turn of normals along edges, folds cut; squared radians."""
    one, other = normals[edges].unbind(dim=1)
    square = (one - other).square().sum(dim=1).clamp_max(_FOLD**2)
    return (square.sum() / max(len(edges), 1)).clamp_min(_LEAST_TURN)


def _variance(confidence: Float[Tensor, " vertex"]) -> Float[Tensor, " vertex"]:
    """Undo confidence: the squared standard error of normals, in radians."""
    half = math.radians(HALF_CONFIDENCE_DEG)
    return half**2 * (1 / confidence.clamp(1e-4, 1 - 1e-3) - 1)
