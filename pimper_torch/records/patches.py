"""Records of all patches, from templates to their photometry.

Patches are grouped in buckets: templates of similar size, padded to one raster and batched.
Records of later stages have the same buckets in the same order.

The patch frame is x right, y down, z forward into the surface: the facet is in the plane z = 0
and its outward normal is -z. A depth on the template is a coordinate along z.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from pimper_torch.records.record import AnyRecord, Record
from pimper_torch.records.scene import CoarseMesh, Mesh
from pimper_torch.records.shapes import Scalars
from pimper_torch.records.value_checks import (
    Faults,
    facing_away,
    faults_in,
    not_finite,
    not_unit,
    out_of_range,
    outside,
)
from pimper_torch.runtime.errors import InputError

AnyPatches = TypeVar("AnyPatches", bound="OverPatches")

INFORMATION = "an inverse variance, 0 where unknown"
"""Valid values of the information of an estimate."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Templates(Record):
    """A bucket of templates: rasters in the planes of their facets.

    Attributes:
        facet: Index of each template's facet in the coarse mesh.
        patch_from_world: Rigid.
        origin: x and y of the first sample's centre, patch frame.
        spacing: Scene units between neighbouring samples; the paper's 1/zeta.
        depth: z of every sample, 0 if the template is flat.
        barycentric: Coordinates of every sample in the facet; one is negative outside the facet.
        inside: True in the enlarged triangle; if the template follows a surface, only where that
            surface exists.
        normals_patch: Normals of the surface that the template follows, unit, facing the viewer.
            ``None`` if the template is flat: the coarse mesh's smoothed normals are used instead.
        views: True for views selected for the bucket, ``None`` if all are. Later records of the
            bucket contain only the selected views, in order.
    """

    facet: Int[Tensor, " patch"]
    patch_from_world: Float[Tensor, "patch 4 4"]
    origin: Float[Tensor, "patch 2"]
    spacing: Float[Tensor, " patch"]
    depth: Float[Tensor, "patch height width"]
    barycentric: Float[Tensor, "patch height width 3"]
    inside: Bool[Tensor, "patch height width"]
    normals_patch: Float[Tensor, "patch height width 3"] | None = None
    views: Bool[Tensor, " view"] | None = None

    def rows(self, num_views: int) -> Int[Tensor, " row"]:
        """Return the indices of the bucket's views, among ``num_views``."""
        if self.views is None:
            return torch.arange(num_views, device=self.facet.device)
        return self.views.nonzero()[:, 0]

    def own(self, record: AnyRecord) -> AnyRecord:
        """Select the bucket's views from a record of all views."""
        return record if self.views is None else record.take(self.views)

    def among_all(self, values: Shaped[Tensor, "..."]) -> Shaped[Tensor, "..."]:
        """Scatter values of the bucket's views, on the second axis, to all views; others are 0."""
        if self.views is None:
            return values
        shape = len(values), len(self.views), *values.shape[2:]
        return values.new_zeros(shape).index_copy(1, self.rows(len(self.views)), values)

    @property
    def points_patch(self) -> Float[Tensor, "patch height width 3"]:
        """Positions of the samples in the patch frame."""
        height, width = self.depth.shape[-2:]
        columns = torch.arange(width, device=self.depth.device, dtype=self.depth.dtype)
        rows = torch.arange(height, device=self.depth.device, dtype=self.depth.dtype)
        x = self.origin[:, 0, None, None] + self.spacing[:, None, None] * columns
        y = self.origin[:, 1, None, None] + self.spacing[:, None, None] * rows[:, None]
        return torch.stack([x.expand_as(self.depth), y.expand_as(self.depth), self.depth], dim=-1)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class OverPatches(Record):
    """Values of all patches, in the same buckets as the templates.

    ``len`` counts patches. Indexing by a facet's number, or iterating, returns records of one
    patch each.
    """

    def __len__(self) -> int:
        return self._templates.num_patches

    def lengths(self) -> dict[str, int]:
        """Return the number of patches; their rasters differ."""
        return {"patch": len(self)}

    def __getitem__(self: AnyPatches, facet: int) -> AnyPatches:
        for index, bucket in enumerate(self._templates.buckets):
            row = (bucket.facet == facet).nonzero()[:, 0]
            if len(row):
                return self._part({index: row[:1]})
        raise IndexError(f"facet {facet} has no patch; there are {len(self)} patches")

    def __iter__(self: AnyPatches) -> Iterator[AnyPatches]:
        facets = torch.cat([bucket.facet for bucket in self._templates.buckets])
        yield from (self[facet] for facet in facets.sort().values.tolist())

    @property
    def _templates(self) -> "PatchSet":
        return self.patches  # type: ignore[attr-defined]

    def of_facets(self: AnyPatches, facets: Bool[Tensor, " facet"]) -> AnyPatches:
        """Return the patches of some facets; patches keep their facet numbers."""
        if bool(facets.all()):
            return self
        rows = {
            index: facets[bucket.facet].nonzero()[:, 0]
            for index, bucket in enumerate(self._templates.buckets)
        }
        return self._part({index: row for index, row in rows.items() if len(row)})

    def _part(self: AnyPatches, rows: Mapping[int, Tensor]) -> AnyPatches:
        """Select rows of buckets, by bucket index, also in the patches that this record is over."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        changes = {
            name: value._part(rows)
            for name, value in values.items()
            if isinstance(value, OverPatches)
        }
        kept = tuple(values["buckets"][index].take(row) for index, row in rows.items())
        return self.replace(**changes, buckets=kept)

    def faults(self) -> Faults:
        """List buckets that differ from the templates', and faults of their values."""
        yield from super(OverPatches, self).faults()
        buckets: tuple[Any, ...] = self.buckets  # type: ignore[attr-defined]
        templates = self._templates.buckets
        if len(buckets) != len(templates):
            needed = f"one for each of {len(templates)} buckets of templates, in the same order"
            yield "buckets", f"has {len(buckets)} entries", needed
        for index, (bucket, template) in enumerate(zip(buckets, templates, strict=False)):
            lengths = bucket.lengths()
            shape = tuple(lengths.get(axis, 0) for axis in ("patch", "height", "width"))
            if shape != tuple(template.inside.shape):
                needed = f"{tuple(template.inside.shape)}, like its templates"
                yield f"buckets[{index}]", f"has patches, height, width {shape}", needed
            for name, found, needed in bucket.faults():
                yield f"buckets[{index}].{name}", found, needed


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PatchSet(OverPatches):
    """Templates of all facets of the coarse mesh, one each.

    Attributes:
        surface: Surface that the templates follow and that occludes; ``None`` for the facets.
    """

    coarse: CoarseMesh
    buckets: tuple[Templates, ...]
    surface: Mesh | None = None

    @property
    def num_patches(self) -> int:
        """Number of patches."""
        return sum(len(bucket.facet) for bucket in self.buckets)

    @property
    def _templates(self) -> "PatchSet":
        return self

    def faults(self) -> Faults:
        """List invalid facet indices and spacings."""
        yield from Record.faults(self)
        if not self.buckets:
            yield "buckets", "is empty", "at least one bucket of templates"
        count = len(self.coarse.mesh.faces)
        for index, bucket in enumerate(self.buckets):
            name, needed = f"buckets[{index}]", f"indices of {count} facets"
            yield from faults_in(f"{name}.facet", needed, out_of_range, bucket.facet, count)
            if not bool((bucket.spacing > 0).all()):
                yield f"{name}.spacing", "is not above 0 everywhere", "scene units"

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        return {
            "patches": self.num_patches,
            "template_samples": sum(int(bucket.inside.sum()) for bucket in self.buckets),
        }


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PatchPriors(Record):
    """A bucket of priors on its templates, merged from all views of a sample.

    Attributes:
        normals_patch: Unit, in the patch frame; arbitrary where the information is 0.
        normal_information: Inverse variance of the normals, one over squared radians.
        offset: Distance of the surface outside the template, along the template's outward normal;
            scene units.
        offset_information: Inverse variance of the offset, one over scene units squared.
        albedo: Gray, up to a factor; 0 without a prior.
        albedo_variance: Relative; infinite without a prior.
        inlier: Probability that a view shows diffuse reflection of its light; 1 where unknown.
            ``None`` without such a prior.
        lights_patch: First-order harmonics in the patch frame, up to a factor; ``None`` without.
        light_variance: Relative; infinite without a prior.
    """

    normals_patch: Float[Tensor, "patch height width 3"]
    normal_information: Float[Tensor, "patch height width"]
    offset: Float[Tensor, "patch height width"]
    offset_information: Float[Tensor, "patch height width"]
    albedo: Float[Tensor, "patch height width"]
    albedo_variance: Float[Tensor, "patch height width"]
    inlier: Float[Tensor, "patch view height width"] | None = None
    lights_patch: Float[Tensor, "patch view 4"] | None = None
    light_variance: Float[Tensor, "patch view"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Observations(Record):
    """A bucket of views resampled on templates: the matrices J and D of its patches.

    Attributes:
        radiance: ``J`` as rasters; zero where missing.
        valid: ``D``: true where the sample is valid in the view.
        priors: Priors of the photographs, if any.
        viewers: Direction to each camera, unit, patch frame; ``None`` if unknown.
    """

    radiance: Float[Tensor, "patch view channel height width"]
    valid: Bool[Tensor, "patch view height width"]
    priors: PatchPriors | None = None
    viewers: Float[Tensor, "patch view 3"] | None = None

    @property
    def gray(self) -> Float[Tensor, "patch view height width"]:
        """Mean over the channels."""
        return self.radiance.mean(dim=2)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PatchViews(OverPatches):
    """Views resampled on all templates: all views, or those selected for a template's bucket."""

    patches: PatchSet
    buckets: tuple[Observations, ...]

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        pairs = list(zip(self.patches.buckets, self.buckets, strict=True))
        samples = sum(int(bucket.inside.sum()) * views.valid.shape[1] for bucket, views in pairs)
        valid = sum(int(views.valid.count_nonzero()) for _, views in pairs)
        return {"samples": samples, "missing_samples": samples - valid}


class StopCause(IntEnum):
    """Why an iteration ended."""

    CONVERGED = 0
    """The steps became smaller than the tolerance."""
    STALLED = 1
    """No step decreases the cost any more, at the limit of rounding."""
    LIMIT = 2
    """The maximum number of iterations was reached."""
    EMPTY = 3
    """There was nothing to fit."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Convergence(Record):
    """End of an iteration, one entry per problem of the batch.

    Attributes:
        iterations: Number of iterations.
        residual: Root mean square over the observed samples, in the units of the data.
    """

    iterations: Int[Tensor, " patch"]
    residual: Float[Tensor, " patch"]
    cause: Int[Tensor, " patch"]

    @property
    def converged(self) -> Bool[Tensor, " patch"]:
        """True if a minimum was reached: neither the limit nor a lack of data ended it."""
        return self.cause <= int(StopCause.STALLED)


class PatchStatus(IntEnum):
    """Whether light determines a patch's shape, or why not."""

    DETERMINED = 0
    """Normals and albedo come from the photographs."""
    UNSEEN = 1
    """No view has a valid sample: all are masked, occluded, too dark or saturated."""
    NOT_FINITE = 2
    """All its radiance is NaN or infinite."""
    FEW_VIEWS = 3
    """No sample is lit in as many views as it has unknowns."""
    CONSTANT_LIGHT = 4
    """The light varied too little between the views, such as under one point light."""
    FAILED = 5
    """The solution is not finite, or its albedo is zero everywhere."""


def confidence_of(information: Scalars) -> Scalars:
    r"""Return a score in [0, 1] for display: :math:`1 / (1 + (\sigma / 8°)^2)`.

    >>> confidence_of(1 / torch.tensor([8.0, 24.0]).deg2rad().square())
    tensor([0.5000, 0.1000])
    """
    half = math.radians(8) ** 2 * information
    return half / (1 + half)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Photometry(Record):
    """A bucket of factorized patches.

    Attributes:
        normals_patch: Unit, facing the viewer (``n_z < 0``).
        albedo: Linear, up to one scale shared by all patches; 0 where it is lit in no view.
        lights_patch: First-order harmonics ``l`` with radiance = albedo * l . (1, n), n in the
            patch frame, constants included. A view without samples has zeros.
        valid: True where photographs determine the sample.
        information: Inverse variance of the normals (mean square angular error), one over squared
            radians; 0 where not valid.
        status: A :class:`PatchStatus` each. A patch that is not determined has the normals of the
            coarse mesh and no valid sample.
        convergence: Of the factorization; the residual is in units of radiance over exposure.
        exposure: Of each view, relative to the median; ``None`` if all are 1.
    """

    normals_patch: Float[Tensor, "patch height width 3"]
    albedo: Float[Tensor, "patch height width channel"]
    lights_patch: Float[Tensor, "patch view 4"]
    valid: Bool[Tensor, "patch height width"]
    information: Float[Tensor, "patch height width"]
    status: Int[Tensor, " patch"]
    convergence: Convergence
    exposure: Float[Tensor, "patch view"] | None = None

    def faults(self) -> Faults:
        """List invalid normals, albedo or information."""
        normals, valid = self.normals_patch, self.valid
        needed = "unit normals where valid"
        yield from faults_in("normals_patch", needed, not_unit, normals, valid)
        needed = "n_z < 0: x right, y down, z into the surface"
        yield from faults_in("normals_patch", needed, facing_away, normals, valid)
        yield from faults_in("albedo", "finite where valid", not_finite, self.albedo, valid)
        yield from faults_in("information", INFORMATION, outside, self.information, torch.inf)

    @property
    def predicted(self) -> Float[Tensor, "patch view channel height width"]:
        """Radiance of every sample in every view, predicted from albedo, normal and light."""
        basis = torch.cat([torch.ones_like(self.normals_patch[..., :1]), self.normals_patch], -1)
        shading = torch.einsum("pvi,phwi->pvhw", self.lights_patch, basis)
        return shading[:, :, None] * self.albedo.movedim(-1, 1)[:, None]

    @property
    def observed(self) -> Bool[Tensor, "patch height width"]:
        """True for samples with albedo: lit in some view, with or without a photometric normal."""
        return (self.albedo > 0).any(dim=-1)

    @property
    def confidence(self) -> Float[Tensor, "patch height width"]:
        """For display: in [0, 1], 0.5 for a standard error of 8 degrees."""
        return confidence_of(self.information)

    @property
    def determined(self) -> Bool[Tensor, " patch"]:
        """True if light determines the patch's shape."""
        return self.status == int(PatchStatus.DETERMINED)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PhotometricPatches(OverPatches):
    """Normals, albedo and light of all patches."""

    patches: PatchSet
    buckets: tuple[Photometry, ...]

    @classmethod
    def of(
        cls,
        patches: "PatchSet | PatchViews",
        *,
        normals: Sequence[Float[Tensor, "_ _ _ 3"]],
        lights: Float[Tensor, "view 4"] | Sequence[Float[Tensor, "_ _ 4"]],
        albedo: Sequence[Float[Tensor, "_ _ _ _"]] | None = None,
        information: Sequence[Float[Tensor, "_ _ _"]] | float = 1 / math.radians(8) ** 2,
    ) -> "PhotometricPatches":
        """Build a record from custom normals, albedo and lights.

        Samples inside their templates whose normal is finite, not zero, and faces the viewer are
        valid. A patch without valid samples is ``UNSEEN``.

        Args:
            patches: Templates, or views on them. With views, a valid sample must be valid in a
                view, and residuals are computed; with templates, residuals are 0.
            normals: Patch frame (x right, y down, z into the surface), of any length; one tensor
                per bucket.
            lights: First-order harmonics, radiance = albedo * l . (1, n): of every view in the
                world frame, or of every view on every patch in the patch frame, one tensor per
                bucket.
            albedo: Linear; one tensor per bucket. 1 by default.
            information: Inverse variance of the normals, one over squared radians: one tensor per
                bucket, or a number for all. By default, that of a standard error of 8 degrees.

        Raises:
            InputError: A number of buckets, a shape or a value does not match the patches.
        """
        templates = patches._templates.buckets

        def by_bucket(name: str, values: Any) -> Sequence[Any]:  # noqa: ANN401
            """Return one value per bucket; repeat a single value."""
            tensors = values if isinstance(values, Sequence) else [values] * len(templates)
            if len(tensors) != len(templates):
                raise InputError(
                    f"PhotometricPatches.of: {name} has {len(tensors)} entries; needed: one tensor "
                    f"for each of {len(templates)} buckets of patches, in the same order."
                )
            return tensors

        views = patches.buckets if isinstance(patches, PatchViews) else None
        columns: dict[str, Any] = {"normals": normals, "lights": lights, "albedo": albedo}
        columns |= {"information": information, "views": views}
        rows = zip(templates, *(by_bucket(*column) for column in columns.items()), strict=True)
        record = cls(patches=patches._templates, buckets=tuple(_given(*row) for row in rows))
        record.check("PhotometricPatches.of")
        return record

    def faults(self) -> Faults:
        """List faults, including normals whose floating-point type differs from the templates'."""
        yield from super(PhotometricPatches, self).faults()
        pairs = zip(self.buckets, self.patches.buckets, strict=False)
        for index, (bucket, template) in enumerate(pairs):
            found, needed = bucket.normals_patch.dtype, template.depth.dtype
            if found != needed:
                name = f"buckets[{index}].normals_patch"
                yield name, f"is of {found}", f"{needed}, like its templates"

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage."""
        pairs = list(zip(self.patches.buckets, self.buckets, strict=True))
        inside = sum(int(templates.inside.sum()) for templates, _ in pairs)
        count = self.patches.num_patches
        convergence = [bucket.convergence for _, bucket in pairs]
        statuses = Counter(code for _, bucket in pairs for code in bucket.status.tolist())
        return {
            "valid_fraction": sum(int(bucket.valid.sum()) for _, bucket in pairs) / inside,
            **{f"{status.name.lower()}_patches": statuses[status] for status in PatchStatus},
            "converged_patches": sum(int(state.converged.sum()) for state in convergence),
            "mean_iterations": sum(float(state.iterations.sum()) for state in convergence) / count,
            "mean_residual": sum(float(state.residual.detach().sum()) for state in convergence)
            / count,
        }


def _given(
    templates: Templates,
    normals: Tensor,
    lights: Tensor,
    albedo: Tensor | None,
    information: Tensor | float,
    views: Observations | None,
) -> Photometry:
    """Build the photometry of a bucket for :meth:`PhotometricPatches.of`."""
    like = templates.depth
    normals = normals.to(like)
    if normals.shape != (*like.shape, 3):
        raise InputError(
            f"PhotometricPatches.of: normals of a bucket have shape {tuple(normals.shape)}; "
            f"needed: patch, height, width, 3: {(*like.shape, 3)}."
        )
    length = normals.norm(dim=-1)
    valid = templates.inside & normals.isfinite().all(dim=-1) & (length > 0) & (normals[..., 2] < 0)
    if views is not None:
        valid = valid & views.valid.any(dim=1)
    facing = like.new_tensor([0.0, 0.0, -1.0])
    unit = torch.where(valid[..., None], normals / length[..., None], facing)
    lights = lights.to(like)
    if lights.ndim == 2:
        lights = lights if templates.views is None else lights[templates.views]
        rotated = torch.einsum("pij,vj->pvi", templates.patch_from_world[:, :3, :3], lights[:, 1:])
        lights = torch.cat([lights[:, :1].expand(len(like), -1, 1), rotated], dim=-1)
    determined = valid.flatten(1).any(dim=1)
    photometry = Photometry(
        normals_patch=unit,
        albedo=torch.ones_like(like)[..., None] if albedo is None else albedo.to(like),
        lights_patch=lights,
        valid=valid,
        information=torch.as_tensor(information, dtype=like.dtype, device=like.device) * valid,
        status=torch.where(determined, int(PatchStatus.DETERMINED), int(PatchStatus.UNSEEN)),
        convergence=Convergence(
            iterations=torch.zeros_like(templates.facet),
            residual=torch.zeros_like(templates.spacing),
            cause=torch.where(determined, int(StopCause.CONVERGED), int(StopCause.EMPTY)),
        ),
    )
    if views is None:
        return photometry
    counted = views.valid & valid[:, None]
    residual = torch.where(counted, views.gray - photometry.predicted.mean(dim=2), 0).flatten(1)
    square = residual.square().sum(dim=1) / counted.flatten(1).sum(dim=1).clamp_min(1)
    return photometry.replace(convergence=photometry.convergence.replace(residual=square.sqrt()))
