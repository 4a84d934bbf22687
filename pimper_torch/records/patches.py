"""Everything that is known facet by facet, from templates to the joined surface.

Patches are kept in buckets: templates of like size, padded to one raster and batched.
Records of later stages have the same buckets in the same order.

The patch frame is x right, y down, z forward into the surface: the facet lies in the
plane z = 0 and its outward normal is -z. A depth on the template is a coordinate along z.
"""

from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.records.record import Record
from pimper_torch.records.scene import CoarseMesh, Mesh


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Templates(Record):
    """A bucket of templates: rasters in the planes of their facets.

    Attributes:
        facet: Which facet of the coarse mesh each template belongs to.
        patch_from_world: Rigid.
        origin: x and y of the first sample's centre, patch frame.
        spacing: Scene units between neighbouring samples; the paper's 1/zeta.
        depth: z of every sample, 0 while the template is flat.
        barycentric: Coordinates of every sample with respect to the facet itself; outside
            the facet one of them is negative.
        inside: True in the enlarged triangle; of a template that carries a surface, only where
            it has some.
        normals_patch: Of the surface that a template carries, unit, facing the viewer. ``None``
            while the template is flat: the coarse mesh's smoothed normals stand in.
    """

    facet: Int[Tensor, " patch"]
    patch_from_world: Float[Tensor, "patch 4 4"]
    origin: Float[Tensor, "patch 2"]
    spacing: Float[Tensor, " patch"]
    depth: Float[Tensor, "patch height width"]
    barycentric: Float[Tensor, "patch height width 3"]
    inside: Bool[Tensor, "patch height width"]
    normals_patch: Float[Tensor, "patch height width 3"] | None = None

    @property
    def points_patch(self) -> Float[Tensor, "patch height width 3"]:
        """The samples' places in the patch frame."""
        height, width = self.depth.shape[-2:]
        columns = torch.arange(width, device=self.depth.device, dtype=self.depth.dtype)
        rows = torch.arange(height, device=self.depth.device, dtype=self.depth.dtype)
        x = self.origin[:, 0, None, None] + self.spacing[:, None, None] * columns
        y = self.origin[:, 1, None, None] + self.spacing[:, None, None] * rows[:, None]
        return torch.stack([x.expand_as(self.depth), y.expand_as(self.depth), self.depth], dim=-1)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PatchSet(Record):
    """The decomposition: every facet of the coarse mesh has one template.

    Attributes:
        coarse: The facets.
        buckets: Their templates.
        surface: What the templates carry, and what hides what; ``None`` for the facets
            themselves.
    """

    coarse: CoarseMesh
    buckets: tuple[Templates, ...]
    surface: Mesh | None = None

    @property
    def num_patches(self) -> int:
        """How many facets there are."""
        return sum(len(bucket.facet) for bucket in self.buckets)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Registered(Record):
    """A bucket of views resampled on templates: the matrices J and D of its patches.

    Attributes:
        radiance: ``J`` before its samples are put in a row; zero where missing.
        valid: ``D``: true where a view has the sample.
    """

    radiance: Float[Tensor, "patch view channel height width"]
    valid: Bool[Tensor, "patch view height width"]

    @property
    def gray(self) -> Float[Tensor, "patch view height width"]:
        """Mean over the channels."""
        return self.radiance.mean(dim=2)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PatchViews(Record):
    """All views, registered on all templates."""

    patches: PatchSet
    buckets: tuple[Registered, ...]


class StopCause(IntEnum):
    """Why an iteration ended."""

    CONVERGED = 0
    """Its steps became smaller than the tolerance."""
    STALLED = 1
    """No step descends any more, as rounding is reached."""
    LIMIT = 2
    """The limit of iterations stopped it."""
    EMPTY = 3
    """There was nothing to fit."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Convergence(Record):
    """How an iteration ended, one entry a problem of the batch.

    Attributes:
        iterations: Taken until it stopped.
        residual: Root mean square over what was observed, in the units of the data.
        cause: A :class:`StopCause` each.
    """

    iterations: Int[Tensor, " patch"]
    residual: Float[Tensor, " patch"]
    cause: Int[Tensor, " patch"]

    @property
    def converged(self) -> Bool[Tensor, " patch"]:
        """Whether a minimum was reached: neither the limit nor lack of data stopped it."""
        return self.cause <= int(StopCause.STALLED)


class PatchVerdict(IntEnum):
    """Whether light told a patch's shape, or what kept it from that."""

    DETERMINED = 0
    """Normals and albedo come from the photographs."""
    UNSEEN = 1
    """No view has a valid sample: all are masked, hidden, too dark or saturated."""
    NOT_FINITE = 2
    """Every radiance that views have there is NaN or infinite."""
    FEW_VIEWS = 3
    """No sample is lit in as many views as it has unknowns."""
    CONSTANT_LIGHT = 4
    """The light varied too little between the views, such as under one lamp."""
    FAILED = 5
    """The solver's answer is not finite or has no albedo anywhere."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Photometry(Record):
    """A bucket of factorized patches.

    Attributes:
        normals_patch: Unit, facing the viewer (``n_z < 0``).
        albedo: Linear, up to one scale shared by all patches.
        lights_patch: Harmonics ``l`` with radiance = albedo * l . (1, n), n in the patch frame,
            constants folded in; of second order nine of them (see
            :class:`~pimper_torch.photometry.manifolds.SecondOrder`). The mean of the channels'
            where they differ. A view without samples has zeros.
        valid: True where the sample was determined by the photographs.
        confidence: In [0, 1]; 0 where not valid.
        verdict: A :class:`PatchVerdict` each. The normals of a patch that is not determined
            are those of the coarse mesh, and none of its samples is valid.
        convergence: Of the factorization.
    """

    normals_patch: Float[Tensor, "patch height width 3"]
    albedo: Float[Tensor, "patch height width channel"]
    lights_patch: Float[Tensor, "patch view harmonic"]
    valid: Bool[Tensor, "patch height width"]
    confidence: Float[Tensor, "patch height width"]
    verdict: Int[Tensor, " patch"]
    convergence: Convergence

    @property
    def determined(self) -> Bool[Tensor, " patch"]:
        """Whether light told the patch's shape."""
        return self.verdict == int(PatchVerdict.DETERMINED)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PhotometricPatches(Record):
    """Normals, albedo and light of all patches."""

    patches: PatchSet
    buckets: tuple[Photometry, ...]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Heights(Record):
    """A bucket of patches swept for height under their light.

    Attributes:
        offset: How far outside the template the surface lies at every sample, along the
            outward normal of what the template carries; scene units, 0 where nothing tells.
        information: Inverse variance of the offset, one over scene units squared; 0 where
            nothing tells. A sample's own share: neighbours that were averaged with it have
            theirs.
        num_views: In how many views a sample of the patch shows, lit or not.
    """

    offset: Float[Tensor, "patch height width"]
    information: Float[Tensor, "patch height width"]
    num_views: Int[Tensor, " patch"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SweptPatches(Record):
    """Heights of all patches, with the photometry they were swept under.

    Attributes:
        photometric: Normals, albedo and light.
        buckets: The heights.
        averaged: Samples in the window that costs were averaged over.
    """

    photometric: PhotometricPatches
    buckets: tuple[Heights, ...]
    averaged: float

    @property
    def patches(self) -> PatchSet:
        """The decomposition underneath."""
        return self.photometric.patches


class AlignVerdict(IntEnum):
    """Whether neighbours bear a patch's relief out."""

    ALIGNED = 0
    """Moved to where it agrees with a neighbour at least."""
    ALONE = 1
    """No neighbour's relief lies over its own: it stays on the mesh."""
    DISPUTED = 2
    """Every neighbour that it meets lies elsewhere, even after all was tried: it stays on
    the mesh."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Depths(Record):
    """A bucket of patches with relief.

    Attributes:
        depth: z of every sample in the patch frame, replacing the template's own.
        valid: True where the relief was integrated or filled from neighbours; false
            outside the enlarged triangle.
        transform: The alignment's ``(h_x, h_y, h_z, h_0)``: ``depth`` is
            ``h . (x, y, z, 1)`` of what integration gave; identity (0, 0, 1, 0) before.
        verdict: An :class:`AlignVerdict` each; ``None`` before alignment.
    """

    depth: Float[Tensor, "patch height width"]
    valid: Bool[Tensor, "patch height width"]
    transform: Float[Tensor, "patch 4"]
    verdict: Int[Tensor, " patch"] | None = None

    @property
    def aligned(self) -> Bool[Tensor, " patch"]:
        """Whether a neighbour bears the relief out; false before alignment."""
        if self.verdict is None:
            return torch.zeros_like(self.transform[:, 0], dtype=torch.bool)
        return self.verdict == int(AlignVerdict.ALIGNED)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DepthPatches(Record):
    """Relief of all patches, with the photometry it was integrated from.

    Attributes:
        photometric: Normals, albedo and light the reliefs come from.
        buckets: The reliefs.
        mismatch: Root mean square distance of neighbouring reliefs where they overlap, scene
            units: before alignment, then after each of its rounds. ``None`` before it.
    """

    photometric: PhotometricPatches
    buckets: tuple[Depths, ...]
    mismatch: Float[Tensor, " round"] | None = None

    @property
    def patches(self) -> PatchSet:
        """The decomposition underneath."""
        return self.photometric.patches


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Surface(Record):
    """The joined surface: every facet subdivided, lattice points on shared edges shared.

    Attributes:
        vertices_world: Where the lattice points came to lie.
        faces: Counter-clockwise from outside.
        facet: A facet each vertex lies in; a shared vertex names one of its facets.
        barycentric: Where in that facet.
        normals_world: Unit, outward; photometric where valid, else of the mesh.
        albedo: Linear, up to one scale; continued from round about where no light tells it.
        confidence: In [0, 1]; 0 where no view determined the vertex.
        convergence: Of the refinement, one entry.
        expected_error: Standard error of each vertex across the surface, scene units, given the
            cameras; ``None`` where nobody tells.
    """

    vertices_world: Float[Tensor, "vertex 3"]
    faces: Int[Tensor, "face 3"]
    facet: Int[Tensor, " vertex"]
    barycentric: Float[Tensor, "vertex 3"]
    normals_world: Float[Tensor, "vertex 3"]
    albedo: Float[Tensor, "vertex channel"]
    confidence: Float[Tensor, " vertex"]
    convergence: Convergence
    expected_error: Float[Tensor, " vertex"] | None = None

    @property
    def mesh(self) -> Mesh:
        """The whole of it, as triangles."""
        return Mesh(
            vertices_world=self.vertices_world,
            faces=self.faces,
            normals_world=self.normals_world,
            albedo=self.albedo,
            confidence=self.confidence,
            expected_error=self.expected_error,
        )
