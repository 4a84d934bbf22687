r"""Differences of depth between neighbouring pixels, from normals.

The unknown is the depth along z for parallel rays, and the logarithm of depth for a pinhole camera.
In the latter case, with the unknown :math:`x` and the ray :math:`(u, v, 1)`,

.. math:: \frac{\partial x}{\partial u} = -\frac{n_u}{n \cdot (u, v, 1)},

and for parallel rays :math:`\partial z / \partial u = -n_u / n_z`. These slopes have no unit;
multiplied by the distance of neighbouring pixels (``unit``: their spacing, or one over the focal
length) they are steps of the unknown.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.geometry.pixels import homogeneous, pixel_centers
from pimper_torch.paper.integrate import fill_smoothly
from pimper_torch.records import Record
from pimper_torch.records.shapes import Mask, Matrix3, Scalars, VectorMap

Changes = Float[Tensor, "line step"]
Known = Bool[Tensor, "line step"]
PerStep = Shaped[Tensor, " step"]
StepsRight = Shaped[Tensor, "height steps_right"]
StepsDown = Shaped[Tensor, "steps_down width"]

# Cosine between ray and normal below which a normal is not used (slope 1000); chosen by hand.
_GRAZING = 1e-3

# The cubic through four slopes is used where it differs from the chord by less than the first, and
# not near creases, where a change of slope exceeds its neighbours' by the second. Chosen by hand.
_MAX_DIFFERENCE, _MAX_KINK = 0.5, 0.3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Steps(Record):
    """Slopes of the steps between neighbouring pixels: those to the right, then those down.

    Attributes:
        slopes: Slopes at every pixel, right and down; inpainted where not valid.
        slope: Slope of every step; 0 outside.
        units: Change of the unknown on a step of slope 1, to the right and down.
        reliable: True if both pixels are inside and have usable normals.
        kink: Change of the slope along the step, minus that of adjacent steps; 0 if smooth.
        twist: The same for the slope across the step; large at depth discontinuities, whose sides
            meet in at most one point.
        valid: Pixels with a usable normal.
    """

    slopes: Float[Tensor, "height width 2"]
    slope: Float[Tensor, " step"]
    units: tuple[float, float]
    reliable: Bool[Tensor, " step"]
    kink: Float[Tensor, " step"]
    twist: Float[Tensor, " step"]
    inside: Mask
    valid: Mask

    @property
    def unit(self) -> Float[Tensor, " step"]:
        """The unit of each step."""
        right, down = self.split(torch.ones_like(self.slope))
        return joined(self.units[0] * right, self.units[1] * down)

    @property
    def target(self) -> tuple[StepsRight, StepsDown]:
        """The differences in units of the unknown, to the right and down."""
        return self.split(self.slope * self.unit)

    def split(self, values: PerStep) -> tuple[StepsRight, StepsDown]:
        """Return values of the steps to the right and down, as rasters."""
        height, width = self.inside.shape
        count = height * (width - 1)
        return values[:count].view(height, width - 1), values[count:].view(height - 1, width)


def joined(right: StepsRight, down: StepsDown) -> PerStep:
    """Join the values of steps to the right and down; see :meth:`Steps.split`."""
    return torch.cat([right.flatten(), down.flatten()])


def at_both_ends(
    combine: Callable[[Tensor, Tensor], Tensor], raster: Shaped[Tensor, "height width"]
) -> PerStep:
    """Combine the values of the pixels at both ends of every step."""
    return joined(combine(raster[:, 1:], raster[:, :-1]), combine(raster[1:], raster[:-1]))


def orthographic_steps(
    normals: VectorMap, mask: Mask, spacing: tuple[float, float] = (1.0, 1.0)
) -> Steps:
    """Return the steps of depth for parallel rays, differentiable in the normals.

    Args:
        normals: Unit, ``n_z < 0``; others are inpainted, and their steps not reliable.
        spacing: Distance of neighbouring pixels in a row and in a column.
    """
    towards = normals.new_tensor([0, 0, 1]).double()
    return _steps(normals, towards.expand(*mask.shape, 3), (0.0, 0.0), mask, spacing)


def perspective_steps(normals: VectorMap, mask: Mask, intrinsics: Matrix3) -> Steps:
    r"""Return the steps of the logarithm of depth for a pinhole camera.

    The tangent planes of both pixels meet on the ray half-way, which is exact for planes:

    .. math:: x_b - x_a = \log \frac{(n_a \cdot r_a)(n_b \cdot r_m)}
                                    {(n_a \cdot r_m)(n_b \cdot r_b)}.

    Args:
        normals: As for :func:`orthographic_steps`, in the camera's frame.

    Source of the meeting planes: Milano, Lopez-Rodriguez, Ott, Siegwart & Chung,
    Discontinuity-aware normal integration for generic central camera models, 2025.
    """
    K = intrinsics.to(normals).double()
    centers = pixel_centers(mask.shape[1], mask.shape[0], like=K)
    rays = homogeneous((centers - K[:2, 2]) / K.diagonal()[:2])
    unit = 1 / float(K[0, 0]), 1 / float(K[1, 1])
    return _steps(normals, rays, unit, mask, unit)


def _between_planes(first: Scalars, second: Scalars, unit: float) -> tuple[Scalars, Scalars]:
    """Return the slope of the step between tangent planes, and the rotation between them."""
    if unit == 0:  # parallel rays; otherwise one over the focal length
        return (first + second) / 2, second - first
    # With r_m half-way, n . r_m / n . r_a = 1 - (slope at a) unit / 2.
    ahead = (1 + unit / 2 * second).clamp_min(_GRAZING).log()
    behind = (1 - unit / 2 * first).clamp_min(_GRAZING).log()
    # The logarithm of a plane's depth is curved: the derivative of its slope is the squared slope.
    rotation = second - first - unit * first * second
    return (ahead - behind) / unit + unit / 24 * (first + second) * rotation, rotation


def _steps(
    normals: VectorMap,
    rays: VectorMap,
    bend: tuple[float, float],
    mask: Mask,
    unit: tuple[float, float],
) -> Steps:
    finite = normals.isfinite().all(dim=-1)
    facing = -(torch.where(finite[..., None], normals, 0).double() * rays).sum(dim=-1)
    valid = mask & finite & (facing > _GRAZING)
    safe = torch.where(valid[..., None], normals.double(), -rays)
    across = (safe[..., :2] / -(safe * rays).sum(dim=-1)[..., None]).movedim(-1, 0)
    slopes = fill_smoothly(across[None], valid.to(across)[None])[0].movedim(0, -1)
    axes = []
    for axis in (0, 1):
        along, across, pixels = slopes[..., axis], slopes[..., 1 - axis], valid
        if axis == 1:
            along, across, pixels = along.mT, across.mT, pixels.mT
        known = pixels[:, 1:] & pixels[:, :-1]
        step, kink = _curved(*_between_planes(along[:, :-1], along[:, 1:], bend[axis]), known)
        result = step, known, kink, _excess(across.diff(dim=1), known)
        axes.append([raster.mT for raster in result] if axis == 1 else result)
    step, reliable, kink, twist = (joined(right, down) for right, down in zip(*axes, strict=True))
    return Steps(
        slopes=slopes,
        slope=torch.where(at_both_ends(torch.logical_and, mask), step, 0),
        units=unit,
        reliable=reliable,
        kink=kink,
        twist=twist,
        inside=mask,
        valid=valid,
    )


def _curved(step: Changes, rotation: Changes, known: Known) -> tuple[Changes, Changes]:
    """Return the steps of the cubic through four slopes, and kinks.

    The step between tangent planes is wrong by a twelfth of the surface's third derivative,
    which accumulates from pixel to pixel on a sphere; the adjacent rotations estimate it.
    """
    before, after = _adjacent(rotation, known)
    has_before, has_after = _adjacent(known.to(rotation), known)
    kink = _excess(rotation, known)
    difference = after - before
    smooth = known & (has_before * has_after > 0)
    smooth = smooth & (difference.abs() < _MAX_DIFFERENCE) & (kink < _MAX_KINK)
    return step - torch.where(smooth, difference, 0) / 24, kink


def _excess(change: Changes, known: Known) -> Changes:
    """Return the excess of a slope's change over that of adjacent steps; no gradient."""
    before, after = _adjacent(change.detach(), known)
    largest = torch.maximum(before.abs(), after.abs())
    return torch.where(known, (change.detach().abs() - largest).clamp_min(0), 0)


def _adjacent(change: Changes, known: Known) -> tuple[Changes, Changes]:
    """Return the changes on the steps before and after each; 0 where those are not reliable."""
    padded = pad(torch.where(known, change, 0), (1, 1))
    return padded[:, :-2], padded[:, 2:]
