"""Records of heights over all patches: swept, integrated, and joined to the surface."""

import math
from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.records.patches import (
    INFORMATION,
    Convergence,
    OverPatches,
    PatchPriors,
    PatchSet,
    PhotometricPatches,
    confidence_of,
)
from pimper_torch.records.record import Record
from pimper_torch.records.scene import Mesh
from pimper_torch.records.shapes import Faces, PerVertex, VertexMask, Vertices
from pimper_torch.records.value_checks import (
    Faults,
    faults_in,
    mean,
    not_finite,
    not_unit,
    outside,
)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class OverPhotometry(OverPatches):
    """Further values over the photometry of all patches."""

    photometric: PhotometricPatches

    @property
    def patches(self) -> PatchSet:
        """The underlying templates."""
        return self.photometric.patches


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Heights(Record):
    """A bucket of patches swept for height under their light.

    Attributes:
        offset: Distance of the surface outside the template at every sample, along the template's
            outward normal; scene units, 0 where unknown.
        information: Inverse variance of the offset, one over scene units squared; 0 where unknown.
            Only the sample's share: averaged neighbours have their own.
        num_views: Number of views that contain a sample of the patch, lit or not.
        priors: Priors of the photographs, if any.
    """

    offset: Float[Tensor, "patch height width"]
    information: Float[Tensor, "patch height width"]
    num_views: Int[Tensor, " patch"]
    priors: PatchPriors | None = None

    def faults(self) -> Faults:
        """List offsets that are not finite, and invalid information."""
        yield from faults_in("offset", "finite, 0 where unknown", not_finite, self.offset)
        yield from faults_in("information", INFORMATION, outside, self.information, torch.inf)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SweptPatches(OverPhotometry):
    """Heights of all patches, with the photometry they were swept under.

    Attributes:
        averaged: Number of samples in the window over which costs were averaged.
    """

    buckets: tuple[Heights, ...]
    averaged: float

    def figures(self) -> dict[str, int | float]:
        """Return the median deviation of priors over its stated error; 1 if variances are right."""
        angles, normals, depths = [], [], []
        for light, height in zip(self.photometric.buckets, self.buckets, strict=True):
            if (prior := height.priors) is not None:
                known = light.valid & (prior.normal_information > 0)
                square = (prior.normals_patch - light.normals_patch)[known].square().sum(dim=-1)
                variance = 1 / prior.normal_information[known] + 1 / light.information[known]
                angles.append(square.detach())
                normals.append((square / variance).detach())
                known = (height.information > 0) & (prior.offset_information > 0)
                square = (prior.offset - height.offset)[known].square()
                variance = 1 / prior.offset_information[known] + 1 / height.information[known]
                depths.append((square / variance).detach())
        metrics: dict[str, int | float] = {}
        if sum(map(len, normals)):
            # Medians of squared Gaussian noise over their mean: log(2) in 2D, 0.4549 in 1D.
            metrics["prior_normals_deg"] = math.degrees(float(torch.cat(angles).median()) ** 0.5)
            metrics["prior_normals_over_claim"] = (
                float(torch.cat(normals).median() / math.log(2)) ** 0.5
            )
        if sum(map(len, depths)):
            metrics["prior_depths_over_claim"] = float(torch.cat(depths).median() / 0.4549) ** 0.5
        return metrics


class AlignStatus(IntEnum):
    """Whether a patch's height field overlaps a neighbour's."""

    ALIGNED = 0
    """Moved to best agreement with its neighbours."""
    ALONE = 1
    """No neighbour's height field overlaps it: it stays on the mesh."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Depths(Record):
    """A bucket of patches with height fields.

    Attributes:
        depth: z of every sample in the patch frame, replacing the template's.
        valid: True where the height field was integrated or filled from neighbours; false
            outside the enlarged triangle.
        transform: The alignment's ``(h_x, h_y, h_z, h_0)``: ``depth`` is
            ``h . (x, y, z, 1)`` of the integrated depth; identity (0, 0, 1, 0) before.
        status: An :class:`AlignStatus` each; ``None`` before alignment.
    """

    depth: Float[Tensor, "patch height width"]
    valid: Bool[Tensor, "patch height width"]
    transform: Float[Tensor, "patch 4"]
    status: Int[Tensor, " patch"] | None = None

    def faults(self) -> Faults:
        """List depths that are not finite."""
        yield from faults_in("depth", "finite where valid", not_finite, self.depth, self.valid)

    @property
    def aligned(self) -> Bool[Tensor, " patch"]:
        """True if the height field was aligned to a neighbour's; false before alignment."""
        if self.status is None:
            return torch.zeros_like(self.transform[:, 0], dtype=torch.bool)
        return self.status == int(AlignStatus.ALIGNED)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DepthPatches(OverPhotometry):
    """Relief of all patches, with the photometry it was integrated from.

    Attributes:
        mismatch: Root mean square distance of overlapping neighbouring height fields, scene
            units: before alignment, then after each of its rounds. ``None`` before alignment.
    """

    buckets: tuple[Depths, ...]
    mismatch: Float[Tensor, " round"] | None = None

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        metrics: dict[str, int | float] = {
            "valid_depths": sum(int(bucket.valid.sum()) for bucket in self.buckets)
        }
        if all(bucket.status is not None for bucket in self.buckets):
            metrics["aligned_patches"] = sum(int(bucket.aligned.sum()) for bucket in self.buckets)
        if self.mismatch is not None:
            metrics["mismatch_before"] = float(self.mismatch[0])
            metrics["mismatch"] = float(self.mismatch[-1])
        return metrics


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Surface(Record):
    """The joined surface: every facet subdivided, with vertices shared along common edges.

    Attributes:
        vertices_world: Positions of the subdivision's vertices.
        faces: Counter-clockwise from outside.
        facet: A facet that contains each vertex; for a shared vertex, one of its facets.
        barycentric: Position in that facet.
        normals_world: Unit, outward: vertex normals of this mesh, kept in the result;
            photometric normals only shaped it. ``paper`` keeps the latter where they exist.
        albedo: Linear, up to one scale; inpainted where no light determines it.
        information: Inverse variance of the photometric normals, one over squared radians; 0
            where light does not determine them.
        height_information: Inverse variance of the swept heights, one over squared scene units;
            0 where not swept.
        convergence: Of the refinement, one entry.
        expected_error: Standard error of each vertex along the surface normal, scene units, with
            the cameras taken as exact; ``None`` if unknown.
    """

    vertices_world: Vertices
    faces: Faces
    facet: Int[Tensor, " vertex"]
    barycentric: Vertices
    normals_world: Vertices
    albedo: Float[Tensor, "vertex channel"]
    information: PerVertex
    height_information: PerVertex
    convergence: Convergence
    expected_error: PerVertex | None = None

    def faults(self) -> Faults:
        """List invalid faces, vertices and normals."""
        yield from self.mesh.faults()
        yield from faults_in("normals_world", "unit, outward", not_unit, self.normals_world, None)

    @property
    def supported(self) -> VertexMask:
        """True where photographs determine the normal or the height."""
        return (self.information > 0) | (self.height_information > 0)

    @property
    def confidence(self) -> PerVertex:
        """For display: in [0, 1], 0.5 for a standard error of 8 degrees."""
        return confidence_of(self.information)

    @property
    def mesh(self) -> Mesh:
        """The complete surface as triangles."""
        return Mesh(
            vertices_world=self.vertices_world,
            faces=self.faces,
            normals_world=self.normals_world,
            albedo=self.albedo,
            confidence=self.confidence,
            expected_error=self.expected_error,
        )

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        return {
            "subdivision_points": len(self.vertices_world),
            "supported_fraction": mean(self.supported.float()),
            "relative_residual": mean(self.convergence.residual),
        }
