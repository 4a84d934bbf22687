"""Height fields on templates: interpolation, and intersection with rays.

A height field is a depth z for every sample of a raster in the patch frame, of at least two samples
a side. Sample (row i, column j) is at ``x = origin_x + j spacing``, ``y = origin_y + i spacing``:
indices, unlike :mod:`~pimper_torch.geometry.pixels`, count from the first sample's centre.
"""

from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.records.shapes import PatchMask, PatchRaster, Scalars

PerPatch = Float[Tensor, " patch"]
Origins = Float[Tensor, "patch 2"]
PerRay = Float[Tensor, "patch ray"]

# A neighbour of less weight may be invalid: rounding must not make a point on a row miss.
_NEGLIGIBLE_WEIGHT = 1e-4


def sample_raster(
    values: Float[Tensor, "patch channel height width"],
    xy: Float[Tensor, "patch ray 2"],
    origin: Origins,
    spacing: PerPatch,
    valid: PatchMask | None = None,
) -> Float[Tensor, "patch channel ray"]:
    """Interpolate the samples of templates bilinearly.

    Args:
        values: Any quantity on the raster: depth, normals, albedo, confidence.
        xy: Positions, patch frame. Outside the raster, values of its border are returned.
        valid: False samples are excluded and the other neighbours share their weight; without a
            valid neighbour the result is zero. ``None`` uses all samples.

    Differentiable in ``values``, and in ``xy`` inside each cell. Interpolated unit normals are not
    unit. To check whether all neighbours are valid, interpolate ``valid[:, None].to(values)`` too.

    >>> ramp = torch.arange(3.0).expand(1, 1, 2, 3)
    >>> zero = torch.zeros(1, 2)
    >>> sample_raster(ramp, torch.tensor([[[0.75, 0.2]]]), zero, torch.tensor([0.5]))
    tensor([[[1.5000]]])
    """
    neighbours, across, down = _cell(xy, origin, spacing, values.shape[-2:])
    weights = _bilinear_weights(across, down)
    corners = _gather(values, neighbours)
    if valid is None:
        return (corners * weights[:, None]).sum(dim=-1)
    valid_corners = _gather(valid[:, None], neighbours)
    weights = weights[:, None] * valid_corners
    total = weights.sum(dim=-1)
    blend = (torch.where(valid_corners, corners, 0) * weights).sum(dim=-1)
    return torch.where(total > 0, blend / torch.where(total > 0, total, 1), 0)


def intersect_height_field(
    depth: PatchRaster,
    valid: PatchMask,
    origin: Origins,
    spacing: PerPatch,
    ray_origins: Float[Tensor, "patch ray 3"],
    ray_directions: Float[Tensor, "patch ray 3"],
    steps: int = 3,
) -> tuple[Float[Tensor, "patch ray 3"], Bool[Tensor, "patch ray"]]:
    r"""Intersect rays with the height field ``z = depth(x, y)``, bilinear between samples.

    Newton steps on :math:`f(t) = o_z + t d_z - \mathrm{depth}(o_{xy} + t d_{xy})` from the point on
    the plane z = 0, with the slope of the bilinear cell. One step is exact on a plane. On a smooth
    height field, three steps converge to rounding for rays within some 60 degrees of the z axis. Of
    several crossings of a ray, the result is usually the nearest to the plane.

    Args:
        depth: z, patch frame; values of invalid samples are ignored.
        ray_origins: Patch frame; any point of the ray. Their dtype is that of the result: float64
            rays are intersected with a float32 height field in float64.
        ray_directions: Any length and sign; the ray is the complete line.

    Returns:
        The points, and whether each is on the height field: all samples that it is interpolated
        from are valid, and the distance along z is at most a fiftieth of the spacing. The point of
        a miss is finite and on the ray, without a meaning.

    Differentiable in ``depth``, ``ray_origins`` and ``ray_directions`` by the implicit function
    theorem: only the last step has gradients, with constant slope, exact if the others converged.
    """
    raster = continued_level(depth, valid).to(ray_origins)
    gap_of = partial(_gap, raster, origin, spacing, ray_origins, ray_directions)
    dz = ray_directions[..., 2]
    min_rate = 1e-3 * ray_directions.norm(dim=-1)
    distance = -ray_origins[..., 2] / _away_from_zero(dz, min_rate)
    with torch.no_grad():
        for _ in range(steps - 1):
            gap, rate = gap_of(distance)
            distance = distance - gap / _away_from_zero(rate, min_rate)
    distance = distance.detach()
    gap, rate = gap_of(distance)
    distance = distance - gap / _away_from_zero(rate.detach(), min_rate)
    points = ray_origins + distance[..., None] * ray_directions

    with torch.no_grad():
        gap, rate = gap_of(distance)
        near = (gap.abs() <= 0.02 * spacing[:, None]) & (rate.abs() > min_rate)
        return points, near & _supported(points[..., :2], origin, spacing, valid)


def _gap(
    raster: PatchRaster,
    origin: Origins,
    spacing: PerPatch,
    ray_origins: Float[Tensor, "patch ray 3"],
    ray_directions: Float[Tensor, "patch ray 3"],
    distance: PerRay,
) -> tuple[PerRay, PerRay]:
    """Return the distance from the height field to the ray along z, and its derivative."""
    x, y, z = ray_origins.unbind(dim=-1)
    dx, dy, dz = ray_directions.unbind(dim=-1)
    _, height, width = raster.shape
    per_sample, flat = (1 / spacing)[:, None], raster.flatten(1)
    column = ((x + distance * dx - origin[:, :1]) * per_sample).clamp(0, width - 1)
    row = ((y + distance * dy - origin[:, 1:]) * per_sample).clamp(0, height - 1)
    left = column.detach().floor().clamp_max(width - 2)
    top = row.detach().floor().clamp_max(height - 2)
    across, down = column - left, row - top
    first = (top * width + left).long()
    top_left, top_right = flat.gather(1, first), flat.gather(1, first + 1)
    low_left, low_right = flat.gather(1, first + width), flat.gather(1, first + width + 1)
    slope_x = torch.lerp(top_right - top_left, low_right - low_left, down)
    upper = top_left + across * (top_right - top_left)
    lower = low_left + across * (low_right - low_left)
    slope_y = lower - upper
    climb = (slope_x * dx + slope_y * dy) * per_sample
    return z + distance * dz - upper - down * slope_y, dz - climb


def _supported(
    xy: Float[Tensor, "patch ray 2"], origin: Origins, spacing: PerPatch, valid: PatchMask
) -> Bool[Tensor, "patch ray"]:
    """Return whether positions are on the raster, and interpolated from valid samples only."""
    neighbours, across, down = _cell(xy, origin, spacing, valid.shape[-2:])
    valid_corners = _gather(valid[:, None], neighbours)[:, 0]
    weight = (_bilinear_weights(across, down) * valid_corners).sum(dim=-1)
    index = (xy - origin[:, None]) / spacing[:, None, None]
    last = index.new_tensor([valid.shape[2] - 1, valid.shape[1] - 1])
    inside = (index >= -_NEGLIGIBLE_WEIGHT) & (index <= last + _NEGLIGIBLE_WEIGHT)
    return inside.all(dim=-1) & (weight >= 1 - _NEGLIGIBLE_WEIGHT)


def continued_level(depth: PatchRaster, valid: PatchMask) -> PatchRaster:
    """Fill invalid samples with the mean of the valid ones among their eight neighbours.

    Newton steps near the rim of the height field then do not depend on invalid values. A sample
    without valid neighbours becomes 0, the facet's plane.
    """
    masked = torch.where(valid, depth, 0)
    count = _sum_of_nine(valid.to(depth)).clamp_min(1)
    return torch.where(valid, depth, _sum_of_nine(masked) / count)


def _sum_of_nine(raster: PatchRaster) -> PatchRaster:
    """Sum every sample and its eight neighbours; avg_pool2d takes ten times as long."""
    wide = pad(raster, (1, 1, 1, 1))
    columns = wide[:, :, :-2] + wide[:, :, 1:-1] + wide[:, :, 2:]
    return columns[:, :-2] + columns[:, 1:-1] + columns[:, 2:]


def _cell(
    xy: Float[Tensor, "patch ray 2"], origin: Origins, spacing: PerPatch, size: torch.Size
) -> tuple[Int[Tensor, "patch ray 4"], PerRay, PerRay]:
    """Return the four samples around each point, and its position in their cell in [0, 1]."""
    height, width = size
    index = (xy - origin[:, None]) / spacing[:, None, None]
    column = index[..., 0].clamp(0, width - 1)
    row = index[..., 1].clamp(0, height - 1)
    left = column.detach().floor().clamp_max(width - 2)
    top = row.detach().floor().clamp_max(height - 2)
    first = (top * width + left).long()
    neighbours = torch.stack([first, first + 1, first + width, first + width + 1], dim=-1)
    return neighbours, column - left, row - top


def _bilinear_weights(across: Scalars, down: Scalars) -> Float[Tensor, "*batch 4"]:
    left, top = 1 - across, 1 - down
    return torch.stack([left * top, across * top, left * down, across * down], dim=-1)


def _gather(
    raster: Float[Tensor, "patch channel height width"]
    | Bool[Tensor, "patch channel height width"],
    neighbours: Int[Tensor, "patch ray 4"],
) -> Float[Tensor, "patch channel ray 4"] | Bool[Tensor, "patch channel ray 4"]:
    channels = raster.shape[1]
    index = neighbours.flatten(1)[:, None].expand(-1, channels, -1)
    return raster.flatten(2).gather(2, index).reshape(*raster.shape[:2], *neighbours.shape[1:])


def _away_from_zero(value: PerRay, least: PerRay) -> PerRay:
    """Clamp the magnitude of a divisor to ``least``, keeping its sign; 1 where ``least`` is 0."""
    sign = torch.where(value < 0, -1.0, 1.0).to(value)
    pushed = torch.where(value.abs() < least, sign * least, value)
    return torch.where(least > 0, pushed, 1)
