"""The union of the patches, sampled on the subdivision of the coarse mesh.

Each vertex of the subdivision has a ray, from its position on the flat facet along the smoothed
normal of the coarse mesh. Normals are interpolated linearly (Phong), so rays are continuous across
facets. The patch of the facet, and neighbours whose enlarged triangle the ray intersects, determine
the height of the surface along the ray.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize
from torch.nn.utils.rnn import pad_sequence

from pimper_torch.geometry.height_fields import intersect_height_field, sample_raster
from pimper_torch.geometry.rigid import rotate, transform
from pimper_torch.geometry.subdivision import Subdivision
from pimper_torch.geometry.surfaces import carried_normals, face_normals
from pimper_torch.linalg.sums import sum_at
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
from pimper_torch.records.shapes import PatchRaster, PatchVectors, PerVertex, VertexMask, Vertices
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.memory import recomputed
from pimper_torch.runtime.parallel import side_by_side

# An outlier at twice the allowed distance has an eleventh of its weight: a choice.
_OUTLIER_PENALTY = 10.0

# Standard deviation of unknown normals from adjacent known ones: a choice, as unknown ones are in
# shadows and at contours, where the surface bends.
_UNKNOWN_NORMAL_DEG = 8.0

# A smaller weight is the tapered border of a patch: a choice.
_MIN_WEIGHT = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Blend(Record):
    """Weighted means of the patches at every vertex of the subdivision.

    Attributes:
        heights: Along the vertex's ray, scene units; 0 where no patch supports the vertex.
        supported: True where a patch has a valid height field.
        normals_world: Photometric, unit; zero where no patch has one.
        albedo: Linear; zero where no patch has one.
        seen: True where the normal is photometric.
        observed: True where a patch has albedo.
        normal_information: Inverse variance of the normals, one over squared radians; 0 where not
            supported or not determined by the photographs.
        offsets: Outward distance of the swept surface from the height fields, along their normals;
            0 where not swept.
        offset_information: Inverse variance of the offsets; 0 where not swept.
        prior_normals_world: Normals of the views' priors, unit; zero where there are none.
        prior_offsets: ``offsets`` by the views' priors.
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
    """Return unit ray directions: interpolated smooth normals of the coarse mesh, world."""
    smooth = subdivision.interpolate(carried_normals(coarse.mesh), coarse.mesh.faces)
    return normalize(smooth, dim=-1)


def vertex_spacing(patches: PatchSet, samples_per_vertex: float) -> Float[Tensor, " facet"]:
    """Return each facet's desired distance between neighbouring vertices, scene units."""
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
    r"""Return the blend of the patches on the subdivision.

    The weight of a patch is :math:`\prod_c s(b_c)` over its barycentric coordinates, where ``s``
    increases smoothly from 0 at the border of the enlarged triangle to 1/2 on the edge of the facet
    and 1 at the same distance inside. The union is continuous across seams, and at the centre of a
    seam both patches have equal weight. If three or more patches overlap, the weight of one that is
    ``d > outlier_samples`` samples from the weighted median is divided by
    ``1 + 10 (d / outlier_samples - 1)^2``, so an outlier is outvoted.

    Normals and swept offsets ``x`` are also weighted by their inverse variance ``I``,
    :math:`\sum w I x / \sum w I`, and the mean has the inverse variance :math:`\sum w I / \sum w`:
    patches share photographs, so their errors are correlated and a second patch adds no
    information. It is never too large, for any correlation, as
    :math:`(\sum w I^{1/2})^2 \le \sum w \sum w I`. Without information ``I = 0``. The fraction
    ``1 - f`` of the weight without normals is assumed to differ from the rest by 8 degrees, which
    adds :math:`(1 - f) / f` times their square to the variance of the mean normal.

    Differentiable in templates, depth, normals, albedo, information and swept heights; the choice
    of patches and samples is constant.
    """
    coarse = depths.patches.coarse
    faces = coarse.mesh.faces
    vertices = _Lists.of(
        subdivision.facet, torch.arange(len(subdivision.points)).to(faces), len(faces)
    )
    # Pairs of facets that share a corner, including each facet with itself, in order.
    owner = torch.arange(len(faces), device=faces.device)[:, None].expand_as(faces).flatten()
    corner = faces.flatten()
    entry, facet = _Lists.of(corner, owner, int(corner.max()) + 1).take(corner)
    pairs = torch.unique(torch.stack([owner[entry], facet], dim=1), dim=0)
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

    The first layer of ``normal``, ``offset`` and the two priors is their information, by which the
    other layers are multiplied; that of ``albedo`` is the fraction of known albedo. ``known`` is
    the fraction of known normals.
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
    """Return estimates where rays intersect the height fields of a bucket's patches."""
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
    # Weight 0 at the end of the band, 1/2 on the edge of the facet, 1 at its width inside.
    fraction = ((barycentric / bands[:, None] + 1) / 2).clamp(0, 1)
    weight = (fraction * fraction * (3 - 2 * fraction)).prod(dim=-1)
    hits = present & hit & (weight > 0)
    xy = points[..., :2]
    raster = templates.origin, templates.spacing
    valid, observed = photometry.valid, photometry.observed
    layers = _weighted_normals(photometry.normals_patch, photometry.information, templates)
    normal = sample_raster(layers, xy, *raster, valid=valid)
    masks = torch.stack([valid, observed], dim=-1).to(layers)
    layers = torch.cat([masks, photometry.albedo], dim=-1)
    known, albedo = sample_raster(layers.movedim(-1, 1), xy, *raster).tensor_split([1], dim=1)
    offset = normal.new_zeros(normal.shape[0], 2, normal.shape[2])
    if swept is not None:
        offset = sample_raster(_weighted_offsets(swept.offset, swept.information), xy, *raster)
    prior_normal, prior_offset = torch.zeros_like(normal), torch.zeros_like(offset)
    if swept is not None and swept.priors is not None:
        priors = swept.priors
        layers = _weighted_normals(priors.normals_patch, priors.normal_information, templates)
        prior_normal = sample_raster(layers, xy, *raster)
        layers = _weighted_offsets(priors.offset, priors.offset_information)
        prior_offset = sample_raster(layers, xy, *raster)
    return _Estimates(
        vertex=vertex[hits],
        height=((points - origins) * along).sum(dim=-1)[hits],
        weight=weight[hits],
        scale=templates.spacing[:, None].expand_as(weight)[hits],
        known=known[:, 0][hits],
        normal=normal.movedim(1, -1)[hits],
        albedo=albedo.movedim(1, -1)[hits],
        offset=offset.movedim(1, -1)[hits],
        prior_normal=prior_normal.movedim(1, -1)[hits],
        prior_offset=prior_offset.movedim(1, -1)[hits],
    )


def _weighted_normals(
    normals_patch: PatchVectors, information: PatchRaster, templates: Templates
) -> Float[Tensor, "patch 4 height width"]:
    """Return layers of information, and of world normals multiplied by it."""
    normals_world = normals_patch @ templates.patch_from_world[:, None, :3, :3]
    layers = torch.cat([information[..., None], information[..., None] * normals_world], dim=-1)
    return layers.movedim(-1, 1)


def _weighted_offsets(
    offset: PatchRaster, information: PatchRaster
) -> Float[Tensor, "patch 2 height width"]:
    """Return layers of information, and of offsets multiplied by it."""
    return torch.stack([information, information * offset], dim=1)


def _bands(
    coarse: CoarseMesh, templates: Templates
) -> tuple[Float[Tensor, "patch 3 2"], Float[Tensor, "patch 3"]]:
    """Return corners in the patch frame, and the width of the blended band outside the facet.

    The band is in barycentric coordinates, and ends slightly inside the enlarged triangle.
    """
    vertices, faces = coarse.mesh.vertices_world, coarse.mesh.faces[templates.facet]
    corners = transform(templates.patch_from_world, vertices[faces])[..., :2]
    opposite = (corners.roll(-1, dims=1) - corners.roll(-2, dims=1)).norm(dim=-1)
    twice_area = face_normals(vertices, faces).norm(dim=-1, keepdim=True)
    step = templates.spacing[:, None] * opposite / twice_area  # barycentric, for one sample
    inside = templates.inside[..., None]
    reach = torch.where(inside, -templates.barycentric, 0).amax(dim=(1, 2))
    # Incomplete cells at a template's border are not hit by rays.
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
    """Return, for each patch, the nearby vertices whose rays may hit its height field.

    Returns:
        Vertices, padded with 0, and the mask of entries that are not padding.
    """
    patch, facet = around.take(templates.facet)
    index, vertex = vertices.take(facet)
    patch = patch[index]
    frame, from_patch = templates.patch_from_world, _barycentric_map(corners)
    start = transform(frame[patch], subdivision.points[vertex, None])[:, 0]
    along = rotate(frame[patch], directions[vertex, None])[:, 0]
    facing = along[:, 2] < -0.2  # within 78 degrees of the patch's normal
    distance = -start[:, 2] / torch.where(facing, along[:, 2], 1)
    crossing = start[:, :2] + distance[:, None] * along[:, :2]
    barycentric = (from_patch[patch, :, :2] @ crossing[..., None])[..., 0] + from_patch[patch, :, 2]
    # A ray may cross the facet's plane further outside and still hit its height field.
    close = (barycentric > -3 * bands[patch]).all(dim=-1)
    near = facing & close
    counts = torch.bincount(patch[near], minlength=len(templates.facet))
    listed = pad_sequence(list(torch.split(vertex[near], counts.tolist())), batch_first=True)
    return listed, torch.arange(listed.shape[1], device=listed.device) < counts[:, None]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Lists:
    """Concatenated lists of indices, of different lengths."""

    start: Int[Tensor, " list"]
    count: Int[Tensor, " list"]
    index: Int[Tensor, " entry"]

    @staticmethod
    def of(which: Int[Tensor, " entry"], index: Int[Tensor, " entry"], size: int) -> "_Lists":
        """Return lists that contain each index in the list of the given number."""
        order = which.argsort(stable=True)
        count = torch.bincount(which, minlength=size)
        return _Lists(start=count.cumsum(0) - count, count=count, index=index[order])

    def take(
        self, which: Int[Tensor, " taken"]
    ) -> tuple[Int[Tensor, " entry"], Int[Tensor, " entry"]]:
        """Return for each entry of the chosen lists its position among them, and its index."""
        count = self.count[which]
        slot = torch.arange(len(which), device=which.device).repeat_interleave(count)
        within = torch.arange(len(slot), device=which.device) - (count.cumsum(0) - count)[slot]
        return slot, self.index[self.start[which][slot] + within]


def _barycentric_map(corners: Float[Tensor, "patch 3 2"]) -> Float[Tensor, "patch 3 3"]:
    """Return the affine map from (x, y, 1) in the patch frame to barycentric coordinates."""
    # Not finite for a facet without area, so no ray counts as near.
    ones = torch.ones_like(corners[..., :1])
    return torch.linalg.inv_ex(torch.cat([corners, ones], dim=-1).mT).inverse


def _blend(estimates: _Estimates, count: int, outlier_samples: float) -> Blend:
    vertex, height = estimates.vertex, estimates.height
    weight = estimates.weight * _agreement(estimates, count, outlier_samples)
    seen_weight = weight * estimates.known
    total, seen = sum_at(vertex, weight, count), sum_at(vertex, seen_weight, count)
    supported = total > _MIN_WEIGHT
    per_support = torch.where(supported, 1 / total.clamp_min(_MIN_WEIGHT), 0)
    normal_information, normals = _mean(vertex, seen_weight, estimates.normal, count)
    offset_information, offsets = _mean(vertex, weight, estimates.offset, count)
    prior_normal_information, prior_normals = _mean(vertex, weight, estimates.prior_normal, count)
    prior_offset_information, prior_offsets = _mean(vertex, weight, estimates.prior_offset, count)
    photometric = (seen > _MIN_WEIGHT) & (normal_information > 0)
    colours = sum_at(vertex, weight[:, None] * estimates.albedo, count)
    observed = colours[:, 0] > _MIN_WEIGHT
    albedo = colours[:, 1:] / torch.where(observed, colours[:, 0], 1)[:, None]
    # Mean normals are less certain where normals are known for a fraction of the weight only.
    information, known = normal_information * per_support, seen * per_support
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
        offset_information=offset_information * per_support,
        prior_normals_world=normalize(prior_normals, dim=-1),
        prior_normal_information=prior_normal_information * per_support,
        prior_offsets=prior_offsets[:, 0],
        prior_offset_information=prior_offset_information * per_support,
    )


def _mean(vertex: Tensor, weight: Tensor, layers: Tensor, count: int) -> tuple[PerVertex, Tensor]:
    """Return summed information, and the mean of values weighted by it; 0 without any."""
    sums = sum_at(vertex, weight[:, None] * layers, count)
    information = sums[:, 0]
    informed = information > 0
    mean = sums[:, 1:] / torch.where(informed, information, 1)[:, None]
    return information, torch.where(informed[:, None], mean, 0)


def _agreement(
    estimates: _Estimates, count: int, outlier_samples: float
) -> Float[Tensor, " estimate"]:
    """Return factors of weights, below 1 far from the weighted median of three or more."""
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
    several = patches[estimates.vertex] >= 3
    beyond = (away.abs() - 1).clamp_min(0)
    leave_out("fuse.outvoted", several & (_OUTLIER_PENALTY * beyond.square() > 1))
    return torch.where(several, 1 / (1 + _OUTLIER_PENALTY * beyond.square()), 1)
