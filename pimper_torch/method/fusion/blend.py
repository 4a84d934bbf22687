"""The union of the patches, sampled on the subdivided mesh of the coarse mesh.

A subdivided mesh vertex has one ray: from its position on the flat facet along the coarse mesh's
smoothed normal, interpolated as Phong does, so that rays are continuous across facets. The
vertex's own patch and the neighbours whose enlarged triangle the ray passes give the height
of the surface along it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize
from torch.nn.utils.rnn import pad_sequence

from pimper_torch.ground.geometry.height_fields import intersect_height_field, sample_raster
from pimper_torch.ground.geometry.rigid import rotate, transform
from pimper_torch.ground.geometry.subdivision import Subdivision
from pimper_torch.ground.geometry.surfaces import face_normals, vertex_normals
from pimper_torch.ground.linalg.sums import sum_at
from pimper_torch.ground.shapes import PerVertex, VertexMask, Vertices
from pimper_torch.records import (
    CoarseMesh,
    DepthPatches,
    Depths,
    Heights,
    PatchSet,
    Photometry,
    Record,
    Templates,
)
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.memory import recomputed
from pimper_torch.runtime.parallel import side_by_side

# An outlier twice as far away as allowed counts an eleventh: a choice.
_DISTRUST = 10.0

# Standard deviation of normals that patches do not know from the known ones beside them: a choice,
# as unknown ones lie in shadows and at contours, where the surface bends.
_UNKNOWN_NORMAL_DEG = 8.0

# Less weight than this is a border that tapered out: a choice.
_MIN_WEIGHT = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Blend(Record):
    """The patches' weighted means at every vertex of the subdivided mesh.

    Attributes:
        heights: Along the vertex's ray, scene units; 0 where no patch supports the vertex.
        supported: True where a patch has a valid height field.
        normals_world: Photometric, unit; zero where no patch has one.
        albedo: Linear; zero where no patch has one.
        seen: True where the normal is photometric.
        observed: True where a patch has albedo.
        normal_information: Inverse variance of the normals, one over squared radians; 0 where not
            supported or not determined by the photographs.
        offsets: How far outside the height fields the sweep has the surface, along their normals;
            0 where not swept.
        offset_information: Inverse variance of the offsets; 0 where not swept.
        prior_normals_world: That were guessed, unit; zero where none was.
        prior_offsets: Like ``offsets``, that were guessed.
    """

    heights: PerVertex
    supported: VertexMask
    normals_world: Vertices
    albedo: Float[Tensor, "vertex channel"]
    seen: VertexMask
    observed: VertexMask
    normal_information: PerVertex
    offsets: PerVertex
    offset_information: PerVertex
    prior_normals_world: Vertices
    prior_normal_information: PerVertex
    prior_offsets: PerVertex
    prior_offset_information: PerVertex


def ray_directions(subdivision: Subdivision, coarse: CoarseMesh) -> Vertices:
    """Return the vertices' rays: smoothed normals of the coarse mesh, interpolated."""
    mesh = coarse.mesh
    normals = mesh.normals_world
    if normals is None:
        normals = vertex_normals(mesh.vertices_world, mesh.faces)
    return normalize(subdivision.interpolate(normals, mesh.faces), dim=-1)


def vertex_spacing(patches: PatchSet, samples_per_vertex: float) -> Float[Tensor, " facet"]:
    """Return each facet's wanted distance between neighbouring vertices, scene units."""
    facet = torch.cat([bucket.facet for bucket in patches.buckets])
    spacing = torch.cat([bucket.spacing for bucket in patches.buckets])
    return torch.empty_like(spacing).index_put((facet,), spacing * samples_per_vertex)


def blend_patches(
    depths: DepthPatches,
    subdivision: Subdivision,
    directions: Vertices,
    outlier_samples: float,
    swept: Sequence[Heights] | None = None,
) -> Blend:
    r"""Blend the patches on the subdivided mesh.

    Each patch counts with :math:`\prod_c s(b_c)` over its barycentric coordinates, where
    ``s`` climbs smoothly from 0 at the border of the enlarged triangle through 1/2 on the
    facet's edge to 1 as far inside: the union is continuous across seams, and on the centre
    of a seam both patches count alike. Where three or more patches meet, one that lies
    ``d > outlier_samples`` samples from the weighted median has its weight divided by
    ``1 + 10 (d / outlier_samples - 1)^2``: a wild patch is outvoted.

    Normals and swept offsets ``x`` of inverse variance ``I`` are averaged by it besides,
    :math:`\sum w I x / \sum w I`, and the mean has the inverse variance
    :math:`\sum w I / \sum w`: patches see the same photographs, so that their errors are
    correlated and a second one adds nothing. It is never too large, whatever the correlation, as
    :math:`(\sum w I^{1/2})^2 \le \sum w \sum w I`. A patch that does not know has ``I = 0``. The
    fraction ``1 - f`` of the weight that is without normals differs from the others by 8 degrees,
    which adds :math:`(1 - f) / f` times their square to the variance of the mean normal.

    Differentiable in templates, depth, normals, albedo, information and swept heights; which
    patches and samples are blended is constant.
    """
    coarse = depths.patches.coarse
    faces = coarse.mesh.faces
    vertices = _Lists.of(
        subdivision.facet, torch.arange(len(subdivision.points)).to(faces), len(faces)
    )
    # Of each facet itself and the facets that share a corner with it, in order.
    own = torch.arange(len(faces), device=faces.device)[:, None].expand_as(faces).flatten()
    corner = faces.flatten()
    taken, facet = _Lists.of(corner, own, int(corner.max()) + 1).take(corner)
    pairs = torch.unique(torch.stack([own[taken], facet], dim=1), dim=0)
    around = _Lists.of(pairs[:, 0], pairs[:, 1], len(faces))
    heights = swept if swept is not None else [None] * len(depths.buckets)
    buckets = zip(
        depths.patches.buckets, depths.buckets, depths.photometric.buckets, heights, strict=True
    )

    def of_bucket(bucket: tuple[Templates, Depths, Photometry, Heights | None]) -> _Estimates:
        return recomputed(_estimates, coarse, *bucket, subdivision, directions, around, vertices)

    estimates = list(side_by_side(of_bucket, list(buckets)))
    return _blend(_Estimates.cat(estimates), len(subdivision.points), outlier_samples)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class _Estimates(Record):
    """Heights, normals, albedo and offsets of single patches at single vertices.

    ``normal`` counts where ``known``, and begins with the information that the rest is multiplied
    by, as ``offset`` and the two priors do. ``albedo`` begins with the fraction that it is known
    of.
    """

    vertex: Int[Tensor, " estimate"]
    height: Float[Tensor, " estimate"]
    weight: Float[Tensor, " estimate"]
    scale: Float[Tensor, " estimate"]
    known: Float[Tensor, " estimate"]
    albedo: Float[Tensor, "estimate layer"]
    normal: Float[Tensor, "estimate 4"]
    offset: Float[Tensor, "estimate 2"]
    prior_normal: Float[Tensor, "estimate 4"]
    prior_offset: Float[Tensor, "estimate 2"]


def _estimates(
    coarse: CoarseMesh,
    templates: Templates,
    height_field: Depths,
    photometry: Photometry,
    swept: Heights | None,
    subdivision: Subdivision,
    directions: Vertices,
    around: "_Lists",
    vertices: "_Lists",
) -> _Estimates:
    """Intersect the rays near each patch of a bucket with its height field."""
    corners, bands = _bands(coarse, templates)
    vertex, present = _rays_near(
        templates, corners, bands, subdivision, directions, around, vertices
    )
    origins = transform(templates.patch_from_world, subdivision.points[vertex])
    along = rotate(templates.patch_from_world, directions[vertex])
    points, hit = intersect_height_field(
        height_field.depth, height_field.valid, templates.origin, templates.spacing, origins, along
    )
    from_patch = _barycentric_map(corners)
    barycentric = points[..., :2] @ from_patch[..., :2].mT + from_patch[:, None, :, 2]
    # Weight 0 at the end of the band, 1/2 on the facet's edge, 1 as far inside.
    fraction = ((barycentric / bands[:, None] + 1) / 2).clamp(0, 1)
    weight = (fraction * fraction * (3 - 2 * fraction)).prod(dim=-1)
    found = present & hit & (weight > 0)
    xy = points[..., :2]
    raster = templates.origin, templates.spacing
    valid, observed = photometry.valid, photometry.observed
    normals_world = photometry.normals_patch @ templates.patch_from_world[:, None, :3, :3]
    certain = photometry.information[..., None]
    layers = torch.cat([certain, certain * normals_world], dim=-1)
    normal = sample_raster(layers.movedim(-1, 1), xy, *raster, valid=valid)
    where = torch.stack([valid, observed], dim=-1).to(layers)
    layers = torch.cat([where, photometry.albedo], dim=-1)
    known, albedo = sample_raster(layers.movedim(-1, 1), xy, *raster).tensor_split([1], dim=1)
    offset = normal.new_zeros(normal.shape[0], 2, normal.shape[2])
    if swept is not None:
        layers = torch.stack([swept.information, swept.information * swept.offset], dim=1)
        offset = sample_raster(layers, xy, *raster)
    prior_normal, prior_offset = torch.zeros_like(normal), torch.zeros_like(offset)
    if swept is not None and swept.priors is not None:
        priors = swept.priors
        certain, sure = priors.normal_information, priors.offset_information
        guessed = priors.normals_patch @ templates.patch_from_world[:, None, :3, :3]
        layers = torch.cat([certain[..., None], certain[..., None] * guessed], dim=-1)
        prior_normal = sample_raster(layers.movedim(-1, 1), xy, *raster)
        layers = torch.stack([sure, sure * priors.offset], dim=1)
        prior_offset = sample_raster(layers, xy, *raster)
    return _Estimates(
        vertex=vertex[found],
        height=((points - origins) * along).sum(dim=-1)[found],
        weight=weight[found],
        scale=templates.spacing[:, None].expand_as(weight)[found],
        known=known[:, 0][found],
        normal=normal.movedim(1, -1)[found],
        albedo=albedo.movedim(1, -1)[found],
        offset=offset.movedim(1, -1)[found],
        prior_normal=prior_normal.movedim(1, -1)[found],
        prior_offset=prior_offset.movedim(1, -1)[found],
    )


def _bands(
    coarse: CoarseMesh, templates: Templates
) -> tuple[Float[Tensor, "patch 3 2"], Float[Tensor, "patch 3"]]:
    """Return corners in the patch frame, and how far outside the facet weights reach.

    The band is in barycentric coordinates and ends a little inside the enlarged triangle.
    """
    vertices, faces = coarse.mesh.vertices_world, coarse.mesh.faces[templates.facet]
    corners = transform(templates.patch_from_world, vertices[faces])[..., :2]
    opposite = (corners.roll(-1, dims=1) - corners.roll(-2, dims=1)).norm(dim=-1)
    twice_area = face_normals(vertices, faces).norm(dim=-1, keepdim=True)
    step = templates.spacing[:, None] * opposite / twice_area  # barycentric, for one sample
    inside = templates.inside[..., None]
    reach = torch.where(inside, -templates.barycentric, 0).amax(dim=(1, 2))
    # At a template's border cells are not whole, so that no ray meets them.
    return corners, torch.maximum(reach - 1.5 * step, step / 2)


def _rays_near(
    templates: Templates,
    corners: Float[Tensor, "patch 3 2"],
    bands: Float[Tensor, "patch 3"],
    subdivision: Subdivision,
    directions: Vertices,
    around: "_Lists",
    vertices: "_Lists",
) -> tuple[Int[Tensor, "patch ray"], Bool[Tensor, "patch ray"]]:
    """List, for each patch, the vertices around it whose rays its height field may meet.

    Returns:
        Vertices, padded with 0, and which entries are no padding.
    """
    patch, facet = around.take(templates.facet)
    index, vertex = vertices.take(facet)
    patch = patch[index]
    frame, from_patch = templates.patch_from_world, _barycentric_map(corners)
    start = transform(frame[patch], subdivision.points[vertex, None])[:, 0]
    along = rotate(frame[patch], directions[vertex, None])[:, 0]
    # At 78 degrees from its normal and more.
    facing = along[:, 2] < -0.2
    distance = -start[:, 2] / torch.where(facing, along[:, 2], 1)
    crossing = start[:, :2] + distance[:, None] * along[:, :2]
    barycentric = (from_patch[patch, :, :2] @ crossing[..., None])[..., 0] + from_patch[patch, :, 2]
    # A ray may cross the facet's plane further outside and still meet its height field.
    close = (barycentric > -3 * bands[patch]).all(dim=-1)
    near = facing & close
    counts = torch.bincount(patch[near], minlength=len(templates.facet))
    listed = pad_sequence(list(torch.split(vertex[near], counts.tolist())), batch_first=True)
    return listed, torch.arange(listed.shape[1], device=listed.device) < counts[:, None]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Lists:
    """Indices in lists of different lengths, one after the other."""

    start: Int[Tensor, " list"]
    count: Int[Tensor, " list"]
    index: Int[Tensor, " entry"]

    @staticmethod
    def of(which: Int[Tensor, " entry"], index: Int[Tensor, " entry"], size: int) -> "_Lists":
        """Put each index into the list that it belongs to."""
        order = which.argsort(stable=True)
        count = torch.bincount(which, minlength=size)
        return _Lists(start=count.cumsum(0) - count, count=count, index=index[order])

    def take(
        self, which: Int[Tensor, " taken"]
    ) -> tuple[Int[Tensor, " entry"], Int[Tensor, " entry"]]:
        """Return the indices in some lists, and which of these lists each is of."""
        count = self.count[which]
        taken = torch.arange(len(which), device=which.device).repeat_interleave(count)
        within = torch.arange(len(taken), device=which.device) - (count.cumsum(0) - count)[taken]
        return taken, self.index[self.start[which][taken] + within]


def _barycentric_map(corners: Float[Tensor, "patch 3 2"]) -> Float[Tensor, "patch 3 3"]:
    """Return the affine map from (x, y, 1) in the patch frame to barycentric coordinates.

    Of a facet without area it is not finite, so that no ray counts as near.
    """
    ones = torch.ones_like(corners[..., :1])
    return torch.linalg.inv_ex(torch.cat([corners, ones], dim=-1).mT).inverse


def _blend(estimates: _Estimates, count: int, outlier_samples: float) -> Blend:
    vertex, height = estimates.vertex, estimates.height
    weight = estimates.weight * _agreement(estimates, count, outlier_samples)
    seen_weight = weight * estimates.known
    total, seen = sum_at(vertex, weight, count), sum_at(vertex, seen_weight, count)
    supported = total > _MIN_WEIGHT
    per_support = torch.where(supported, 1 / total.clamp_min(_MIN_WEIGHT), 0)
    by = weight[:, None]
    certain, normals = _split(sum_at(vertex, seen_weight[:, None] * estimates.normal, count))
    swept, offsets = _split(sum_at(vertex, by * estimates.offset, count))
    guessed, prior_normals = _split(sum_at(vertex, by * estimates.prior_normal, count))
    told, prior_offsets = _split(sum_at(vertex, by * estimates.prior_offset, count))
    photometric = (seen > _MIN_WEIGHT) & (certain > 0)
    colours = sum_at(vertex, weight[:, None] * estimates.albedo, count)
    observed = colours[:, 0] > _MIN_WEIGHT
    albedo = colours[:, 1:] / torch.where(observed, colours[:, 0], 1)[:, None]
    # Less is known of mean normals where patches know them for a fraction of the weight.
    information, known = certain * per_support, seen * per_support
    unknown = (1 - known).clamp_min(0) / known.clamp_min(_MIN_WEIGHT)
    variance = math.radians(_UNKNOWN_NORMAL_DEG) ** 2
    return Blend(
        heights=sum_at(vertex, weight * height, count) * per_support,
        supported=supported,
        normals_world=normalize(normals, dim=-1) * photometric[:, None],
        albedo=albedo * observed[:, None],
        seen=photometric,
        observed=observed,
        normal_information=information / (1 + information * variance * unknown) * photometric,
        offsets=offsets[:, 0],
        offset_information=swept * per_support,
        prior_normals_world=normalize(prior_normals, dim=-1),
        prior_normal_information=guessed * per_support,
        prior_offsets=prior_offsets[:, 0],
        prior_offset_information=told * per_support,
    )


def _split(sums: Float[Tensor, "vertex layer"]) -> tuple[PerVertex, Float[Tensor, "vertex value"]]:
    """Return the summed information and the mean by it of what follows; 0 where there is none."""
    information = sums[:, 0]
    some = information > 0
    mean = sums[:, 1:] / torch.where(some, information, 1)[:, None]
    return information, torch.where(some[:, None], mean, 0)


def _agreement(
    estimates: _Estimates, count: int, outlier_samples: float
) -> Float[Tensor, " estimate"]:
    """Lower the weight of an estimate far from the weighted median of three or more."""
    with torch.no_grad():
        by_height = estimates.height.argsort(stable=True)
        order = by_height[estimates.vertex[by_height].argsort(stable=True)]
        vertex, weight = estimates.vertex[order], estimates.weight[order].double()
        patches = torch.bincount(vertex, minlength=count)
        total = sum_at(vertex, weight, count)
        running = weight.cumsum(0)
        before = (total.cumsum(0) - total)[vertex]
        below = sum_at(vertex, (running - before < total[vertex] / 2).long(), count)
        centre = (patches.cumsum(0) - patches + below.clamp_max((patches - 1).clamp_min(0)))[vertex]
        nearest = torch.empty_like(order)
        nearest[order] = order[centre]
    median = estimates.height[nearest]
    away = (estimates.height - median) / (outlier_samples * estimates.scale)
    many = patches[estimates.vertex] >= 3
    beyond = (away.abs() - 1).clamp_min(0)
    leave_out("fuse.outvoted", many & (_DISTRUST * beyond.square() > 1))
    return torch.where(many, 1 / (1 + _DISTRUST * beyond.square()), 1)
