"""Height fields on templates: looking values up, and where rays meet the height field.

A height field is a depth z for every sample of a raster in the patch frame. Sample (row i,
column j) lies at ``x = origin_x + j spacing``, ``y = origin_y + i spacing``, so counting
from the first sample's centre is :func:`~pimper_torch.ground.geometry.pixels.indices_from_pixels`
already undone. Rasters have at least two samples a side.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.ground.shapes import PatchMask, PatchRaster, Scalars

PerPatch = Float[Tensor, " patch"]
Origins = Float[Tensor, "patch 2"]
PerRay = Float[Tensor, "patch ray"]

# A neighbour that carries less of the blend than this may be invalid: a point that lies on
# a row of samples must not miss because rounding put it a hair off the row.
_NEGLIGIBLE_WEIGHT = 1e-4


def sample_raster(
    values: Float[Tensor, "patch channel height width"],
    xy: Float[Tensor, "patch ray 2"],
    origin: Origins,
    spacing: PerPatch,
    valid: PatchMask | None = None,
) -> Float[Tensor, "patch channel ray"]:
    """Look values up between the samples of a template, bilinearly.

    Args:
        values: Anything kept on the raster: depth, normals, albedo, confidence.
        xy: Where, patch frame. Outside the raster the nearest border answers.
        valid: Samples that are false stay out of the blend and the others share their
            weight; where no neighbour is valid the answer is zero. ``None`` trusts all.

    Differentiable in ``values``, and in ``xy`` inside each cell. Blended unit normals are
    not unit. To learn whether the answer rests on valid samples only, look up
    ``valid[:, None].to(values)`` as well.

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
    known = _gather(valid[:, None], neighbours)
    weights = weights[:, None] * known
    total = weights.sum(dim=-1)
    blend = (torch.where(known, corners, 0) * weights).sum(dim=-1)
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
    r"""Find where rays meet the height field ``z = depth(x, y)``, bilinear between samples.

    From the point on the plane z = 0, Newton's steps on
    :math:`f(t) = o_z + t d_z - \mathrm{depth}(o_{xy} + t d_{xy})`, with the slope of the
    bilinear cell. One step is exact on a plane; three bring a smooth height field to rounding
    for rays within some 60 degrees of the z axis. Rays that would cross the height field several
    times find the crossing Newton leads to, usually the one nearest to the plane.

    Args:
        depth: z, patch frame; what invalid samples hold does not matter.
        ray_origins: Patch frame; any point of the ray. Their dtype is that of the answer:
            float64 rays meet a float32 height field in float64.
        ray_directions: Any length and sign; the ray is the whole line.

    Returns:
        The points, and whether each is on the height field: all neighbours it is blended from
        are valid, and the line passes it within a fiftieth of the spacing. A miss gives a
        point on the ray that means nothing, though it is finite.

    Differentiable in ``depth``, ``ray_origins`` and ``ray_directions`` by the implicit
    function: only the last step carries gradients, with its slope held, which is exact once
    the steps before it have converged.
    """
    x, y, z = ray_origins.unbind(dim=-1)
    dx, dy, dz = ray_directions.unbind(dim=-1)
    count, height, width = depth.shape
    raster = continued_level(depth, valid).to(ray_origins).reshape(count, -1)
    per_sample = (1 / spacing)[:, None]

    def gap_at(distance: PerRay) -> tuple[PerRay, PerRay]:
        """Return the ray's height over the height field along z, and its derivative."""
        column = ((x + distance * dx - origin[:, :1]) * per_sample).clamp(0, width - 1)
        row = ((y + distance * dy - origin[:, 1:]) * per_sample).clamp(0, height - 1)
        left = column.detach().floor().clamp_max(width - 2)
        top = row.detach().floor().clamp_max(height - 2)
        across, down = column - left, row - top
        first = (top * width + left).long()
        top_left, top_right = raster.gather(1, first), raster.gather(1, first + 1)
        low_left, low_right = raster.gather(1, first + width), raster.gather(1, first + width + 1)
        slope_x = torch.lerp(top_right - top_left, low_right - low_left, down)
        upper = top_left + across * (top_right - top_left)
        lower = low_left + across * (low_right - low_left)
        slope_y = lower - upper
        climb = (slope_x * dx + slope_y * dy) * per_sample
        return z + distance * dz - upper - down * slope_y, dz - climb

    normal_enough = 1e-3 * ray_directions.norm(dim=-1)
    distance = -z / _away_from_zero(dz, normal_enough)
    with torch.no_grad():
        for _ in range(steps - 1):
            gap, rate = gap_at(distance)
            distance = distance - gap / _away_from_zero(rate, normal_enough)
    distance = distance.detach()
    gap, rate = gap_at(distance)
    distance = distance - gap / _away_from_zero(rate.detach(), normal_enough)
    points = ray_origins + distance[..., None] * ray_directions

    with torch.no_grad():
        gap, rate = gap_at(distance)
        neighbours, across, down = _cell(points[..., :2], origin, spacing, depth.shape[-2:])
        known = _gather(valid[:, None], neighbours)[:, 0]
        supported = (_bilinear_weights(across, down) * known).sum(dim=-1)
        index = (points[..., :2] - origin[:, None]) / spacing[:, None, None]
        last = index.new_tensor([depth.shape[2] - 1, depth.shape[1] - 1])
        slack = _NEGLIGIBLE_WEIGHT
        hit = (
            (supported >= 1 - slack)
            & ((index >= -slack) & (index <= last + slack)).all(dim=-1)
            & (gap.abs() <= 0.02 * spacing[:, None])
            & (rate.abs() > normal_enough)
        )
    return points, hit


def continued_level(depth: PatchRaster, valid: PatchMask) -> PatchRaster:
    """Assign invalid samples the mean of the valid ones among their eight neighbours.

    Rays that pass over the rim of the height field on their way are then not thrown off by what
    lies beyond it. A sample without valid neighbours becomes 0, the facet's plane.
    """
    known = torch.where(valid, depth, 0)
    count = _sum_of_nine(valid.to(depth)).clamp_min(1)
    return torch.where(valid, depth, _sum_of_nine(known) / count)


def _sum_of_nine(raster: PatchRaster) -> PatchRaster:
    """Add up every sample and its eight neighbours; avg_pool2d takes ten times as long."""
    wide = pad(raster, (1, 1, 1, 1))
    columns = wide[:, :, :-2] + wide[:, :, 1:-1] + wide[:, :, 2:]
    return columns[:, :-2] + columns[:, 1:-1] + columns[:, 2:]


def _cell(
    xy: Float[Tensor, "patch ray 2"], origin: Origins, spacing: PerPatch, size: torch.Size
) -> tuple[Int[Tensor, "patch ray 4"], PerRay, PerRay]:
    """Return the four samples around each point, and its place between them in [0, 1]."""
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
    where = neighbours.flatten(1)[:, None].expand(-1, channels, -1)
    return raster.flatten(2).gather(2, where).reshape(*raster.shape[:2], *neighbours.shape[1:])


def _away_from_zero(value: PerRay, least: PerRay) -> PerRay:
    """Keep a divisor's sign but not a size below ``least``; 1 for a ray without direction."""
    sign = torch.where(value < 0, -1.0, 1.0).to(value)
    pushed = torch.where(value.abs() < least, sign * least, value)
    return torch.where(least > 0, pushed, 1)
