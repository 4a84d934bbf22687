"""Everything that is known facet by facet, from templates to the joined surface.

Patches are kept in buckets: templates of like size, padded to one raster and batched.
Records of later stages have the same buckets in the same order.

The patch frame is x right, y down, z forward into the surface: the facet lies in the
plane z = 0 and its outward normal is -z. A depth on the template is a coordinate along z.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from pimper_torch.ground.shapes import Faces, PerVertex, Scalars, VertexMask, Vertices
from pimper_torch.records.record import AnyRecord, Record
from pimper_torch.records.scene import CoarseMesh, Mesh
from pimper_torch.records.value_checks import (
    Faults,
    beyond,
    faults_in,
    not_finite,
    not_unit,
    outside,
    turned_away,
)
from pimper_torch.runtime.errors import InputError

AnyPatches = TypeVar("AnyPatches", bound="OverPatches")

_INFORMATION = "an inverse variance, 0 where unknown"


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
        views: Which of all views the bucket is seen in, where it is not all of them: later records
            of it have these alone, in their order.
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
        """Return the numbers of the views, of ``num_views``, that the bucket is seen in."""
        if self.views is None:
            return torch.arange(num_views, device=self.facet.device)
        return self.views.nonzero()[:, 0]

    def own(self, record: AnyRecord) -> AnyRecord:
        """Take the views that the bucket is seen in from a record of all views."""
        return record if self.views is None else record.take(self.views)

    def among_all(self, values: Shaped[Tensor, "..."]) -> Shaped[Tensor, "..."]:
        """Put values of the bucket's views, along the second axis, among those of all views.

        Zero in those that the bucket is not seen in.
        """
        if self.views is None:
            return values
        shape = len(values), len(self.views), *values.shape[2:]
        return values.new_zeros(shape).index_copy(1, self.rows(len(self.views)), values)

    @property
    def points_patch(self) -> Float[Tensor, "patch height width 3"]:
        """The samples' positions in the patch frame."""
        height, width = self.depth.shape[-2:]
        columns = torch.arange(width, device=self.depth.device, dtype=self.depth.dtype)
        rows = torch.arange(height, device=self.depth.device, dtype=self.depth.dtype)
        x = self.origin[:, 0, None, None] + self.spacing[:, None, None] * columns
        y = self.origin[:, 1, None, None] + self.spacing[:, None, None] * rows[:, None]
        return torch.stack([x.expand_as(self.depth), y.expand_as(self.depth), self.depth], dim=-1)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class OverPatches(Record):
    """A result over all patches, in buckets like those of the templates.

    ``len`` counts patches, and indexing by a facet's number, or iterating, gives records of one
    patch each.
    """

    def __len__(self) -> int:
        return self._templates.num_patches

    def lengths(self) -> dict[str, int]:
        """Return the number of patches: their rasters differ."""
        return {"patch": len(self)}

    def __getitem__(self: AnyPatches, facet: int) -> AnyPatches:
        for index, bucket in enumerate(self._templates.buckets):
            row = (bucket.facet == facet).nonzero()[:, 0]
            if len(row):
                return self._part({index: row[:1]})
        raise IndexError(f"no patch stands on facet {facet}; there are {len(self)} patches")

    def __iter__(self: AnyPatches) -> Iterator[AnyPatches]:
        facets = torch.cat([bucket.facet for bucket in self._templates.buckets])
        yield from (self[facet] for facet in facets.sort().values.tolist())

    @property
    def _templates(self) -> "PatchSet":
        found: PatchSet = self.patches  # type: ignore[attr-defined]
        return found

    def of_facets(self: AnyPatches, facets: Bool[Tensor, " facet"]) -> AnyPatches:
        """Return the patches of some facets, which keep their numbers."""
        if bool(facets.all()):
            return self
        rows = {
            index: facets[bucket.facet].nonzero()[:, 0]
            for index, bucket in enumerate(self._templates.buckets)
        }
        return self._part({index: row for index, row in rows.items() if len(row)})

    def _part(self: AnyPatches, rows: Mapping[int, Tensor]) -> AnyPatches:
        """Take rows of buckets, by the number of each, here and in the patches that it is over."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        changes = {
            name: value._part(rows)
            for name, value in values.items()
            if isinstance(value, OverPatches)
        }
        kept = tuple(values["buckets"][index].take(row) for index, row in rows.items())
        return self.replace(**changes, buckets=kept)

    def faults(self) -> Faults:
        """List buckets that are not those of the templates, and what is wrong in one."""
        yield from super(OverPatches, self).faults()
        buckets: tuple[Any, ...] = self.buckets  # type: ignore[attr-defined]
        templates = self._templates.buckets
        if len(buckets) != len(templates):
            needed = f"one for each of {len(templates)} buckets of templates, in their order"
            yield "buckets", f"are {len(buckets)}", needed
        for index, (bucket, own) in enumerate(zip(buckets, templates, strict=False)):
            lengths = bucket.lengths()
            shape = tuple(lengths.get(axis, 0) for axis in ("patch", "height", "width"))
            if shape != tuple(own.inside.shape):
                needed = f"{tuple(own.inside.shape)}, as its templates"
                yield f"buckets[{index}]", f"has patches, height, width {shape}", needed
            for name, found, needed in bucket.faults():
                yield f"buckets[{index}].{name}", found, needed


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PatchSet(OverPatches):
    """The decomposition: every facet of the coarse mesh has one template.

    Attributes:
        surface: Surface that the templates carry and that occludes; ``None`` for the facets.
    """

    coarse: CoarseMesh
    buckets: tuple[Templates, ...]
    surface: Mesh | None = None

    @property
    def num_patches(self) -> int:
        """Number of facets."""
        return sum(len(bucket.facet) for bucket in self.buckets)

    @property
    def _templates(self) -> "PatchSet":
        return self

    def faults(self) -> Faults:
        """List templates of facets that are none, and of no size."""
        yield from Record.faults(self)
        if not self.buckets:
            yield "buckets", "are none", "a bucket of templates at least"
        count = len(self.coarse.mesh.faces)
        for index, bucket in enumerate(self.buckets):
            name, needed = f"buckets[{index}]", f"indices of {count} facets"
            yield from faults_in(f"{name}.facet", needed, beyond, bucket.facet, count)
            if not bool((bucket.spacing > 0).all()):
                yield f"{name}.spacing", "is not above 0 everywhere", "scene units"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class PatchPriors(Record):
    """A bucket of priors on its templates, those of all views that see a sample merged.

    Attributes:
        normals_patch: Unit, in the patch frame; anything where the information is 0.
        normal_information: Inverse variance of the normals, one over squared radians.
        offset: How far outside the template the surface is, along the outward normal of what the
            template carries; scene units.
        offset_information: Inverse variance of the offset, one over scene units squared.
        albedo: Gray, up to a factor; 0 where nothing is guessed.
        albedo_variance: Relative; infinite where nothing is guessed.
        inlier: Probability that a view shows diffuse reflection of its light; 1 where unknown.
            ``None`` without such a prior.
        lights_patch: First-order harmonics in the patch frame, up to a factor. ``None`` without.
        light_variance: Relative; infinite where nothing is guessed.
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
        radiance: ``J`` before its samples are put in a row; zero where missing.
        valid: ``D``: true where a view has the sample.
        priors: What was guessed of the photographs, if anything.
        viewers: Direction to each camera, unit, patch frame; ``None`` where unknown.
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
    """Views, registered on all templates: all of them, or those of a template's bucket."""

    patches: PatchSet
    buckets: tuple[Observations, ...]


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
    """End of an iteration, one entry a problem of the batch.

    Attributes:
        iterations: Taken until it stopped.
        residual: Root mean square over what was observed, in the units of the data.
    """

    iterations: Int[Tensor, " patch"]
    residual: Float[Tensor, " patch"]
    cause: Int[Tensor, " patch"]

    @property
    def converged(self) -> Bool[Tensor, " patch"]:
        """Whether a minimum was reached: neither the limit nor lack of data stopped it."""
        return self.cause <= int(StopCause.STALLED)


class PatchStatus(IntEnum):
    """Whether light determines a patch's shape, or why not."""

    DETERMINED = 0
    """Normals and albedo come from the photographs."""
    UNSEEN = 1
    """No view has a valid sample: all are masked, hidden, too dark or saturated."""
    NOT_FINITE = 2
    """Every radiance that views have there is NaN or infinite."""
    FEW_VIEWS = 3
    """No sample is lit in as many views as it has unknowns."""
    CONSTANT_LIGHT = 4
    """The light varied too little between the views, such as under one point light."""
    FAILED = 5
    """The solver's answer is not finite or has no albedo anywhere."""


def confidence_of(information: Scalars) -> Scalars:
    r"""Return a score in [0, 1] for people: :math:`1 / (1 + (\sigma / 8°)^2)`.

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
        albedo: Linear, up to one scale shared by all patches; 0 where no view shows it lit.
        lights_patch: First-order harmonics ``l`` with radiance = albedo * l . (1, n), n in the
            patch frame, constants folded in. A view without samples has zeros.
        valid: True where the sample was determined by the photographs.
        information: Inverse variance of the normals, the mean square of their angular error;
            one over squared radians, 0 where not valid.
        status: A :class:`PatchStatus` each. The normals of a patch that is not determined
            are those of the coarse mesh, and none of its samples is valid.
        convergence: Of the factorization; the residual is one of radiance over exposure.
        exposure: Of each view, relative to the median; ``None`` where all are 1.
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
        """List values that are no normals, albedo or information."""
        normals, valid = self.normals_patch, self.valid
        needed = "unit normals where valid"
        yield from faults_in("normals_patch", needed, not_unit, normals, valid)
        needed = "n_z < 0: x right, y down, z into the surface"
        yield from faults_in("normals_patch", needed, turned_away, normals, valid)
        yield from faults_in("albedo", "finite where valid", not_finite, self.albedo, valid)
        yield from faults_in("information", _INFORMATION, outside, self.information, torch.inf)

    @property
    def predicted(self) -> Float[Tensor, "patch view channel height width"]:
        """Radiance of every sample in every view, as albedo, normal and light say."""
        basis = torch.cat([torch.ones_like(self.normals_patch[..., :1]), self.normals_patch], -1)
        shading = torch.einsum("pvi,phwi->pvhw", self.lights_patch, basis)
        return shading[:, :, None] * self.albedo.movedim(-1, 1)[:, None]

    @property
    def observed(self) -> Bool[Tensor, "patch height width"]:
        """Where views show the sample lit, so that it has albedo, with or without a normal."""
        return (self.albedo > 0).any(dim=-1)

    @property
    def confidence(self) -> Float[Tensor, "patch height width"]:
        """For people: in [0, 1], a half for a standard error of 8 degrees."""
        return confidence_of(self.information)

    @property
    def determined(self) -> Bool[Tensor, " patch"]:
        """Whether light determines the patch's shape."""
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
        """Put normals, albedo and lights of one's own on patches.

        Samples inside their templates whose normal is finite, not zero, and faces the viewer are
        valid. A patch without any is ``UNSEEN``.

        Args:
            patches: Templates, or views on them: then a sample has to be seen, too, and residuals
                are those of the views. Of templates alone they are 0.
            normals: Patch frame (x right, y down, z into the surface), of any length; one tensor a
                bucket.
            lights: First-order harmonics, radiance = albedo * l . (1, n): of every view in the
                world frame, or of every view on every patch in the patch frame, one tensor a
                bucket.
            albedo: Linear; one tensor a bucket. 1 unless given.
            information: Inverse variance of the normals, one over squared radians: one tensor a
                bucket, or a number for all. A standard error of 8 degrees unless given.

        Raises:
            InputError: A number of buckets, a shape or a value that does not belong to the patches.
        """
        templates = patches._templates.buckets

        def each(name: str, values: Any) -> Sequence[Any]:  # noqa: ANN401
            """Return one value a bucket: those given, or the one for all."""
            several = values if isinstance(values, Sequence) else [values] * len(templates)
            if len(several) != len(templates):
                raise InputError(
                    f"PhotometricPatches.of: {name} are {len(several)}; needed: one tensor for "
                    f"each of {len(templates)} buckets of patches, in their order."
                )
            return several

        views = patches.buckets if isinstance(patches, PatchViews) else None
        columns: dict[str, Any] = {"normals": normals, "lights": lights, "albedo": albedo}
        columns |= {"information": information, "views": views}
        rows = zip(templates, *(each(*column) for column in columns.items()), strict=True)
        found = cls(patches=patches._templates, buckets=tuple(_given(*row) for row in rows))
        found.check("PhotometricPatches.of")
        return found

    def faults(self) -> Faults:
        """List normals of another floating-point type than the templates, too."""
        yield from super(PhotometricPatches, self).faults()
        pairs = zip(self.buckets, self.patches.buckets, strict=False)
        for index, (bucket, own) in enumerate(pairs):
            found, needed = bucket.normals_patch.dtype, own.depth.dtype
            if found != needed:
                name = f"buckets[{index}].normals_patch"
                yield name, f"is of {found}", f"{needed}, as its templates"


def _given(
    templates: Templates,
    normals: Tensor,
    lights: Tensor,
    albedo: Tensor | None,
    information: Tensor | float,
    views: Observations | None,
) -> Photometry:
    """Make the photometry of a bucket, see :meth:`PhotometricPatches.of`."""
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
    facing = torch.tensor([0.0, 0.0, -1.0]).to(like)
    unit = torch.where(valid[..., None], normals / length[..., None], facing)
    lights = lights.to(like)
    if lights.ndim == 2:
        lights = lights if templates.views is None else lights[templates.views]
        rotated = torch.einsum("pij,vj->pvi", templates.patch_from_world[:, :3, :3], lights[:, 1:])
        lights = torch.cat([lights[:, :1].expand(len(like), -1, 1), rotated], dim=-1)
    determined = valid.flatten(1).any(dim=1)
    found = Photometry(
        normals_patch=unit,
        albedo=torch.ones_like(like)[..., None] if albedo is None else albedo.to(like),
        lights_patch=lights,
        valid=valid,
        information=torch.as_tensor(information).to(like) * valid,
        status=torch.where(determined, int(PatchStatus.DETERMINED), int(PatchStatus.UNSEEN)),
        convergence=Convergence(
            iterations=torch.zeros_like(templates.facet),
            residual=torch.zeros_like(templates.spacing),
            cause=torch.where(determined, int(StopCause.CONVERGED), int(StopCause.EMPTY)),
        ),
    )
    if views is None:
        return found
    counted = views.valid & valid[:, None]
    off = torch.where(counted, views.gray - found.predicted.mean(dim=2), 0).flatten(1)
    square = off.square().sum(dim=1) / counted.flatten(1).sum(dim=1).clamp_min(1)
    return found.replace(convergence=found.convergence.replace(residual=square.sqrt()))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class OverPhotometry(OverPatches):
    """Further results over the photometry of all patches."""

    photometric: PhotometricPatches

    @property
    def patches(self) -> PatchSet:
        """The decomposition underneath."""
        return self.photometric.patches


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Heights(Record):
    """A bucket of patches swept for height under their light.

    Attributes:
        offset: How far outside the template the surface is at every sample, along the outward
            normal of what the template carries; scene units, 0 where unknown.
        information: Inverse variance of the offset, one over scene units squared; 0 where unknown.
            A sample's own share: neighbours that were averaged with it have theirs.
        num_views: In how many views a sample of the patch shows, lit or not.
        priors: What was guessed of the photographs, if anything.
    """

    offset: Float[Tensor, "patch height width"]
    information: Float[Tensor, "patch height width"]
    num_views: Int[Tensor, " patch"]
    priors: PatchPriors | None = None

    def faults(self) -> Faults:
        """List heights that are nowhere, and weights that are none."""
        yield from faults_in("offset", "finite, 0 where unknown", not_finite, self.offset)
        yield from faults_in("information", _INFORMATION, outside, self.information, torch.inf)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SweptPatches(OverPhotometry):
    """Heights of all patches, with the photometry they were swept under.

    Attributes:
        averaged: Samples in the window that costs were averaged over.
    """

    buckets: tuple[Heights, ...]
    averaged: float


class AlignStatus(IntEnum):
    """Whether a patch's height field meets a neighbour's."""

    ALIGNED = 0
    """Moved to where it agrees best with its neighbours."""
    ALONE = 1
    """No neighbour's height field overlaps its own: it stays on the mesh."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Depths(Record):
    """A bucket of patches with height field.

    Attributes:
        depth: z of every sample in the patch frame, replacing the template's own.
        valid: True where the height field was integrated or filled from neighbours; false
            outside the enlarged triangle.
        transform: The alignment's ``(h_x, h_y, h_z, h_0)``: ``depth`` is
            ``h . (x, y, z, 1)`` of what integration gave; identity (0, 0, 1, 0) before.
        status: An :class:`AlignStatus` each; ``None`` before alignment.
    """

    depth: Float[Tensor, "patch height width"]
    valid: Bool[Tensor, "patch height width"]
    transform: Float[Tensor, "patch 4"]
    status: Int[Tensor, " patch"] | None = None

    def faults(self) -> Faults:
        """List depths that are nowhere."""
        yield from faults_in("depth", "finite where valid", not_finite, self.depth, self.valid)

    @property
    def aligned(self) -> Bool[Tensor, " patch"]:
        """Whether the height field meets a neighbour's; false before alignment."""
        if self.status is None:
            return torch.zeros_like(self.transform[:, 0], dtype=torch.bool)
        return self.status == int(AlignStatus.ALIGNED)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DepthPatches(OverPhotometry):
    """Relief of all patches, with the photometry it was integrated from.

    Attributes:
        mismatch: Root mean square distance of neighbouring height fields where they overlap, scene
            units: before alignment, then after each of its rounds. ``None`` before it.
    """

    buckets: tuple[Depths, ...]
    mismatch: Float[Tensor, " round"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Surface(Record):
    """The joined surface: every facet subdivided, subdivided mesh points on shared edges shared.

    Attributes:
        vertices_world: Where the subdivided mesh points came to lie.
        faces: Counter-clockwise from outside.
        facet: A facet each vertex lies in; a shared vertex names one of its facets.
        barycentric: Where in that facet.
        normals_world: Unit, outward: vertex normals of this mesh, which the result keeps; those
            of factorization only shaped it. ``paper`` keeps photometric normals where there are.
        albedo: Linear, up to one scale; continued from round about where no light tells it.
        information: Inverse variance of the photometric normals, one over squared radians; 0
            where light does not determine them.
        height_information: Inverse variance of the swept heights, one over squared scene units;
            0 where not swept.
        convergence: Of the refinement, one entry.
        expected_error: Standard error of each vertex across the surface, scene units, given the
            cameras; ``None`` where unknown.
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
        """List faces that name no vertex, vertices that are nowhere, and what is no normal."""
        yield from self.mesh.faults()
        yield from faults_in("normals_world", "unit, outward", not_unit, self.normals_world, None)

    @property
    def supported(self) -> VertexMask:
        """Where photographs determine the normal or the height."""
        return (self.information > 0) | (self.height_information > 0)

    @property
    def confidence(self) -> PerVertex:
        """For people: in [0, 1], a half for a standard error of 8 degrees."""
        return confidence_of(self.information)

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
