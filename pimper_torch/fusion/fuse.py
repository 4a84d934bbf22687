"""The stage that makes one surface of slopes, swept heights and the cloud's points."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.config import require
from pimper_torch.fusion.bands import CoarsePart
from pimper_torch.fusion.blend import Blend, blend_patches, ray_directions, vertex_spacing
from pimper_torch.fusion.contacts import Contacts, Ground, cloud_points, contour_tangents, passing
from pimper_torch.fusion.continuation import about_mean, continued, enclosed
from pimper_torch.fusion.estimate import Fused, fuse_terms
from pimper_torch.fusion.expected_error import expected_error
from pimper_torch.fusion.normal_bias import (
    MEDIAN_OF_TILT,
    NormalBias,
    alike,
    common_variance,
    normal_bias,
)
from pimper_torch.fusion.terms import (
    Common,
    Terms,
    kept_slopes,
    kept_steps,
    slopes,
    swept_heights,
    upright,
    upright_heights,
)
from pimper_torch.geometry.subdivision import Subdivision, subdivide, transferred
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.topology import face_edges
from pimper_torch.records import (
    Convergence,
    DepthPatches,
    Depths,
    Record,
    StopCause,
    Surface,
    SweptPatches,
)
from pimper_torch.silhouettes.contours import Contours
from pimper_torch.stage import Stage

# Information that every vertex holds to where it is by, in units of one over its spacing
# squared: as if it were known to 100 spacings. It decides where nothing else does.
_DAMPING = 1e-4

# Points of the cloud further off the surface than this, in its spacings, are not of it.
_REACH = 20.0

# What the evidence errs by is learnt on a subdivided mesh so many times as coarse. The noise
# factors of the demo's last round are found within 15 % on one four times as coarse, too.
_COARSER = 2.0

# A turn from vertex to vertex that is larger, in radians, is a fold's.
_FOLD = 0.25

# Squared turn from vertex to vertex that even flat facets are said to have, radians; and the
# least variance of the slopes that a surface has already.
_MIN_ROTATION, _MIN_DOUBT = 1e-8, 1e-6

# Standard error of slopes that a surface without any normal has: a choice.
_UNKNOWN_SLOPE_DEG = 8.0

# Normals count as if they had this standard error at least, and at most. No normals of rendered
# scenes are as good as the one in the mean (1.6 degrees, `benchmarks/README.md`); the other only
# keeps numbers in range.
_NORMAL_ERROR_DEG = 0.25, 800.0

# Between its vertices the surface is flat: points tell no more than this fraction of a spacing.
_FINEST = 0.03


# How far, in samples, a patch may lie from the others before they outvote it.
_OUTLIER_SAMPLES = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FuseConfig:
    """Which evidence takes part, and how the noise of each is found.

    Attributes:
        samples_per_vertex: Template samples between neighbouring vertices of the surface.
            Time and memory fall with its square.
        slopes: Whether normals take part.
        heights: Whether swept heights do.
        points: Whether the cloud's points do.
        contours: Whether the rays through the silhouettes do.
        bias_iterations: How often the tilt that all normals of a facet share, and the height that
            all swept heights of a facet are off by, are estimated, and the tilt taken out; 0
            trusts both at all wavelengths.
        noise_iterations: Solves in which the noise of each kind of evidence is estimated and
            outliers lose weight: for each estimate of the tilt and twice after them on a coarser
            subdivided mesh, and twice at full size.
        error_draws: Of noise, for the expected error of every vertex; the more, the less it is
            off by chance: 8 by a quarter. 0 gives none.
    """

    samples_per_vertex: float = 1.0
    slopes: bool = True
    heights: bool = True
    points: bool = True
    contours: bool = True
    bias_iterations: int = 2
    noise_iterations: int = 3
    error_draws: int = 8

    def __post_init__(self) -> None:
        each = self.samples_per_vertex
        require(each > 0, "fuse.samples_per_vertex", each, "above 0")
        require(
            self.bias_iterations >= 0, "fuse.bias_iterations", self.bias_iterations, "0 or more"
        )
        require(self.error_draws >= 0, "fuse.error_draws", self.error_draws, "0 or more")
        require(
            self.noise_iterations >= 1, "fuse.noise_iterations", self.noise_iterations, "1 or more"
        )
        some = self.slopes or self.heights or self.points or self.contours
        require(some, "fuse.slopes", self.slopes, "true unless heights or points are")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Task(Record):
    """The subdivided mesh, and what the patches together say at its vertices.

    Attributes:
        subdivision: The facets, subdivided.
        facets: The coarse mesh's faces.
        directions: Along which heights count.
        blend: What the patches say.
        places: Of the vertices on what the templates carry.
        shape: The normals of that.
        edges: Of the subdivided mesh.
        spacing: Of its vertices, scene units.
        correlated: Vertices in a window of the sweep.
    """

    subdivision: Subdivision
    facets: Int[Tensor, "facet 3"]
    directions: Float[Tensor, "vertex 3"]
    blend: Blend
    places: Float[Tensor, "vertex 3"]
    shape: Float[Tensor, "vertex 3"]
    edges: Int[Tensor, "edge 2"]
    spacing: Float[Tensor, ""]
    correlated: float


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Learnt(Record):
    """What a coarser subdivided mesh tells about the evidence.

    Attributes:
        tilt: That the normals of each facet share; ``None`` if nothing tells.
        left: Variance of what is left of it once it is taken out.
        height: Variance of what the swept heights of a facet are off by together.
        fine: The solve that trusts normals singly.
        coarse: The solve that knows what they err by together.
    """

    tilt: NormalBias | None
    left: Float[Tensor, ""]
    height: Float[Tensor, ""] | None
    fine: Fused
    coarse: Fused


class Fuse(Stage):
    """Solve for the surface that all evidence suits best, over the whole connected subdivided mesh.

    Unknown is the height of every subdivided mesh vertex along the coarse mesh's smoothed normal.
    Terms is linear in it: edges are at right angles to photometric normals, the sweep knows
    heights, the cloud's points lie on the surface, rays through the silhouettes touch it, and where
    no light tells anything the surface keeps the slopes it has, or continues those of lit ground
    that encloses it (:mod:`~pimper_torch.fusion.continuation`). Across contours and folds, as seen
    along the directions, no normal can be followed, and heights go on differing as they do. Each
    kind comes with the variances that its source claims; what these must be multiplied by is
    estimated from the residuals (:mod:`~pimper_torch.fusion.estimate`). Normals of one facet err
    alike, as they were found under one light: the tilt they share is estimated from the positions
    and taken out. So do swept heights: what they are off by together is estimated from the other
    kinds, and they count for no more than that lets them know
    (:mod:`~pimper_torch.fusion.normal_bias`). Detail is that of single normals, the coarse shape
    that of normals known to err alike (:mod:`~pimper_torch.fusion.bands`).

    The surface's normals are its own; its albedo is continued over what no light tells,
    without confidence. Differentiable in templates, normals, albedo, information, swept heights
    and the cloud, through every solve; which patches, samples, edges, vertices and faces take part
    is constant.
    """

    def __init__(self, config: FuseConfig | None = None) -> None:
        super().__init__()
        self.config = config or FuseConfig()

    def forward(self, swept: SweptPatches, contours: Contours, expected: bool = True) -> Surface:
        """Fuse what is known of all patches.

        Args:
            swept: Photometry and swept heights of all patches.
            contours: What silhouettes say about the surface.
            expected: Whether the expected error of every vertex is found.

        The convergence's residual is the root mean square distance that the surface moved, in
        scene units; its iterations are the solves at full size.

        Raises:
            InputError: A normal that is not unit, an inverse variance below 0 or a height that
                is not finite.
        """
        rough = self._task(swept, _COARSER * self.config.samples_per_vertex)
        contacts = self._contacts(rough, swept, contours)
        learnt = self._learnt(rough, contacts)
        task = self._task(swept, self.config.samples_per_vertex)
        solved, solves = self._solved(task, contacts, learnt)
        subdivision, directions, blend = task.subdivision, task.directions, task.blend
        heights = solved.to(blend.heights)
        vertices = subdivision.points + heights[:, None] * directions
        normals = vertex_normals(vertices, subdivision.faces)
        error = None
        if expected and self.config.error_draws > 0:
            error = self._expected_error(rough, learnt, task, normals)
        moved = (heights - blend.heights).detach()
        return Surface(
            vertices_world=vertices,
            faces=subdivision.faces,
            facet=subdivision.facet,
            barycentric=subdivision.barycentric,
            normals_world=normals,
            albedo=about_mean(blend.albedo, blend.seen, task.edges),
            information=blend.normal_information,
            expected_error=error,
            convergence=Convergence(
                iterations=torch.full((1,), solves, device=moved.device),
                residual=moved.square().mean().sqrt()[None],
                cause=torch.full((1,), int(StopCause.CONVERGED), device=moved.device),
            ),
        )

    def _task(self, swept: SweptPatches, samples_per_vertex: float) -> _Task:
        """Lay a subdivided mesh over the facets, and read the patches there."""
        patches = swept.patches
        facets = patches.coarse.mesh.faces
        spacing = vertex_spacing(patches, samples_per_vertex)
        subdivision = subdivide(patches.coarse.mesh.vertices_world, facets, spacing)
        directions = ray_directions(subdivision, patches.coarse)
        blend = blend_patches(
            transferred_height_fields(swept),
            subdivision,
            directions,
            _OUTLIER_SAMPLES,
            swept.buckets,
        )
        # A vertex stands for so many samples, each of which has its own share.
        density = samples_per_vertex**2
        places = subdivision.points + blend.heights[:, None] * directions
        return _Task(
            subdivision=subdivision,
            facets=facets,
            directions=directions,
            blend=blend.replace(offset_information=density * blend.offset_information),
            places=places,
            shape=vertex_normals(places, subdivision.faces),
            edges=face_edges(subdivision.faces)[0],
            spacing=spacing.median(),
            correlated=max(1.0, swept.averaged / density),
        )

    def _expected_error(
        self, rough: _Task, learnt: _Learnt, task: _Task, normals: Float[Tensor, "vertex 3"]
    ) -> Float[Tensor, " vertex"]:
        """Give the expected error across the surface; heights count along directions."""
        along = expected_error(
            learnt.fine, learnt.coarse, rough.subdivision, rough.facets, self.config.error_draws
        )
        along = transferred(along, rough.subdivision, task.subdivision).to(normals)
        facing = (normals.detach() * task.directions.detach()).sum(dim=-1).abs()
        return torch.hypot(along * facing, _FINEST * task.spacing.detach())

    def _heights(self, task: _Task, common: Float[Tensor, ""] | None) -> list[Terms]:
        """List what the sweep knows, given the variance of what a facet's heights share."""
        if not self.config.heights:
            return []
        blend = task.blend
        facing = (task.shape * task.directions).sum(dim=-1)
        told = blend.heights, blend.offsets, blend.offset_information, facing
        upright = upright_heights(blend.offset_information, facing)
        shared = None if common is None else alike(common, task.subdivision.facet, upright)
        return [swept_heights(*told, task.correlated, shared)]

    def _contacts(self, task: _Task, swept: SweptPatches, contours: Contours) -> list[Contacts]:
        """List the places that the surface passes through: the cloud's points, and contours."""
        ground, cloud = _ground(task), swept.patches.coarse.points
        found = []
        if self.config.points and cloud is not None:
            found.append(cloud_points(cloud, ground))
        touched = contours.touching(task.places, task.shape)
        if self.config.contours and len(touched.ray):
            found.append(contour_tangents(touched, ground))
        return found

    def _learnt(self, task: _Task, contacts: list[Contacts]) -> _Learnt:
        """Estimate the noise of each kind of evidence, and what facets err by together."""
        config, subdivision, blend = self.config, task.subdivision, task.blend
        points = passing(contacts, _ground(task))
        heights = self._heights(task, None)
        known, lit = self._known(task)
        unlit = self._unlit(task, known, lit)

        def solve(
            normals: Float[Tensor, "vertex 3"],
            positions: list[Terms],
            common: Common | None = None,
        ) -> Fused:
            kinds = [*unlit, *positions, self._slopes(task, lit, normals, common)]
            return fuse_terms(kinds, blend.heights, _damping(task), config.noise_iterations)

        normals, shape, height = blend.normals_world, task.shape, None
        if config.bias_iterations == 0 or not bool(lit.any()) or not (heights or points):
            only = solve(normals, [*points, *heights])
            nothing = only.damping.new_zeros(())
            return _Learnt(tilt=None, left=nothing, height=None, fine=only, coarse=only)
        # Heights are judged by the others first, which they would draw along.
        positions = points or heights
        for _ in range(config.bias_iterations):
            apart = normal_bias(subdivision, task.facets, normals, shape, known)
            fused = solve(normals, positions, alike(apart.variance(), subdivision.facet, known))
            moved = fused.heights.to(task.places)
            shape = vertex_normals(
                subdivision.points + moved[:, None] * task.directions, subdivision.faces
            )
            if points and heights:
                held = subdivision.facet[torch.cat([kind.unknowns[:, 0] for kind in points])]
                height = common_variance(heights[0], fused.heights, subdivision.facet, held)
                positions = [*points, *self._heights(task, height)]
        tilt = normal_bias(subdivision, task.facets, normals, shape, known)
        normals = normalize(normals + tilt.at(subdivision, task.facets), dim=-1)
        left = normal_bias(subdivision, task.facets, normals, shape, known).variance()
        return _Learnt(
            tilt=tilt,
            left=left,
            height=height,
            fine=solve(normals, positions),
            coarse=solve(normals, positions, alike(left, subdivision.facet, known)),
        )

    def _solved(
        self, task: _Task, contacts: list[Contacts], learnt: _Learnt
    ) -> tuple[Float[Tensor, " vertex"], int]:
        """Solve at full size, given what the coarser subdivided mesh tells; and count the solves.

        Noise is judged anew: what the coarser subdivided mesh finds noisier than claimed may be its
        own coarseness.
        """
        subdivision, blend = task.subdivision, task.blend
        known, lit = self._known(task)
        kinds = [
            *self._unlit(task, known, lit),
            *passing(contacts, _ground(task)),
            *self._heights(task, learnt.height),
        ]
        iterations = self.config.noise_iterations

        def solve(
            normals: Float[Tensor, "vertex 3"],
            common: Common | None = None,
            near: Float[Tensor, " vertex"] | None = None,
        ) -> Float[Tensor, " vertex"]:
            told = [*kinds, self._slopes(task, lit, normals, common)]
            return fuse_terms(told, blend.heights, _damping(task), iterations, near).heights

        if learnt.tilt is None:
            return solve(blend.normals_world), iterations
        tilt = learnt.tilt.at(subdivision, task.facets)
        normals = normalize(blend.normals_world + tilt, dim=-1)
        fine = solve(normals)
        coarse = solve(normals, alike(learnt.left, subdivision.facet, known), near=fine)
        return fine + CoarsePart(subdivision, task.facets)(coarse - fine), 2 * iterations

    def _known(self, task: _Task) -> tuple[Bool[Tensor, " vertex"], Bool[Tensor, " edge"]]:
        """Mark vertices that light tells normals of, and the edges between such."""
        blend = task.blend
        known = blend.seen & self.config.slopes
        lit = known[task.edges].all(dim=1)
        return known, lit & upright(task.edges, task.directions, blend.normals_world)

    def _slopes(
        self,
        task: _Task,
        lit: Bool[Tensor, " edge"],
        normals: Float[Tensor, "vertex 3"],
        common: Common | None = None,
    ) -> Terms:
        """Give what the normals say, singly or knowing what they err by together."""
        variance = _variance(task.blend.normal_information)
        edges = task.edges[lit]
        return slopes(edges, task.subdivision.points, task.directions, normals, variance, common)

    def _unlit(
        self, task: _Task, known: Bool[Tensor, " vertex"], lit: Bool[Tensor, " edge"]
    ) -> list[Terms]:
        """List the slopes where light tells nothing; no residual tells their variances.

        Where lit ground encloses it, its normals are continued: the shape there is what the
        facets started with, since no round knew it. Elsewhere the shape is kept. Continued normals
        of a facet are off alike: together they tell as much as one of them.
        """
        flat, along, edges = task.subdivision.points, task.directions, task.edges
        transferred, doubt = task.blend.heights, self._doubt(task, known)
        alike = doubt * torch.bincount(task.subdivision.facet)[task.subdivision.facet].to(
            task.shape
        )
        island = enclosed(known, task.subdivision.faces)
        normals = task.blend.normals_world
        if bool(island.any()):
            damping = _rotation(task.shape, edges[lit]) / alike
            normals = normalize(continued(normals, ~island, edges, task.shape, damping), dim=-1)
        over = island[edges].any(dim=1) & upright(edges, along, normals)
        stays = ~lit & ~over
        sloped = stays & upright(edges, along, task.shape)
        return [
            slopes(edges[over], flat, along, normals, alike).replace(
                correlated=(alike / doubt)[edges[over]].mean(dim=1), judged=False
            ),
            kept_slopes(edges[sloped], flat, along, task.shape, transferred, doubt),
            kept_steps(edges[stays & ~sloped], flat, transferred, doubt),
        ]

    def _doubt(self, task: _Task, known: Bool[Tensor, " vertex"]) -> Float[Tensor, ""]:
        """Estimate the variance of the slopes that the surface has already, from the others."""
        if not bool(known.any()):
            return task.shape.new_tensor(math.radians(_UNKNOWN_SLOPE_DEG) ** 2)
        apart = (task.blend.normals_world - task.shape)[known].square().sum(dim=-1)
        return (apart.median() / MEDIAN_OF_TILT).clamp_min(_MIN_DOUBT)


def _ground(task: _Task) -> Ground:
    """Give the surface that the vertices lie on now."""
    return Ground(
        places=task.places,
        faces=task.subdivision.faces,
        heights=task.blend.heights,
        directions=task.directions,
        reach=float(_REACH * task.spacing.detach()),
        finest=_FINEST * task.spacing,
    )


def _damping(task: _Task) -> Float[Tensor, " vertex"]:
    return (_DAMPING / task.spacing**2).expand_as(task.blend.heights)


def transferred_height_fields(swept: SweptPatches) -> DepthPatches:
    """Take what the templates carry as their height field."""
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


def _rotation(
    normals: Float[Tensor, "vertex 3"], edges: Int[Tensor, "edge 2"]
) -> Float[Tensor, ""]:
    """Give the mean squared turn of normals along edges, folds cut; squared radians."""
    one, other = normals[edges].unbind(dim=1)
    square = (one - other).square().sum(dim=1).clamp_max(_FOLD**2)
    return (square.sum() / max(len(edges), 1)).clamp_min(_MIN_ROTATION)


def _variance(information: Float[Tensor, " vertex"]) -> Float[Tensor, " vertex"]:
    """Give the variance of normals, radians squared, within what single precision can solve for."""
    low, high = (math.radians(error) ** 2 for error in _NORMAL_ERROR_DEG)
    return 1 / information.clamp(1 / high, 1 / low)
