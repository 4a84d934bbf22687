r"""Closed-form surfaces from one viewpoint: balls and bumps, and their bas-relief alignment.

Depth is a sum of Gaussian bumps, or a ball's, so slopes are exact; each region has one albedo.
Camera frame: x right, y down, z forward, normals facing the viewer.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.scenes.render_in_memory import EndlessPlane
from pimper_bench.scenes.textures import Waves
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.single_view.factorization.bas_relief import BasRelief

_NEWTON_STEPS = 30  # quadratic convergence needs about 6


@dataclass(frozen=True, slots=True, kw_only=True)
class WavyPlane:
    """A gently wavy plane in the world: ``z = height field(x, y)``.

    The first hit is found by Newton's method from the plane ``z = 0``, so the rays must be
    steeper than the height field everywhere.
    """

    height_field: Waves

    def intersect(
        self, origins: Float[Tensor, "*#batch 3"], directions: Float[Tensor, "*#batch 3"]
    ) -> Float[Tensor, "*batch"]:
        """Follow the ray until it is level with the height field."""
        start = EndlessPlane().intersect(origins, directions)
        distance = torch.where(start.isfinite(), start, 0)
        for _ in range(_NEWTON_STEPS):
            points = origins + distance[..., None] * directions
            gap = points[..., 2] - self.height_field(points[..., :2])
            slope = self._slope(points[..., :2])
            closing = directions[..., 2] - (slope * directions[..., :2]).sum(-1)
            distance = distance - gap / closing
        return torch.where(start.isfinite(), distance, torch.inf)

    def normals(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Lean against the gradient."""
        slope = self._slope(points[..., :2])
        return normalize(torch.cat([-slope, torch.ones_like(slope[..., :1])], dim=-1), dim=-1)

    def _slope(self, places: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        waves = self.height_field
        vectors = waves.wave_vectors.to(places)
        angle = places @ vectors.mT + waves.phases.to(places)
        return (angle.cos() * waves.amplitudes.to(places)) @ vectors


def ball(
    size: int, rim_deg: float = 75.0
) -> tuple[Float[Tensor, "size size 3"], Bool[Tensor, "size size"]]:
    """Return the normals of a ball that fills a square image, orthographic, and its mask.

    Args:
        size: Of the image.
        rim_deg: The mask ends where the normals turn away from the viewer by this.
    """
    side = torch.sin(torch.deg2rad(torch.tensor(rim_deg, dtype=torch.float64)))
    xy = side * (_grid(size) * 2 / size - 1)
    square = xy.square().sum(dim=-1, keepdim=True)
    normals = torch.cat([xy, -(1 - square).clamp_min(0).sqrt()], dim=-1)
    return normalize(normals, dim=-1), square[..., 0] < side**2


def bumps(
    size: int, generator: torch.Generator, steepest: float = 1.0, count: int = 8
) -> tuple[Float[Tensor, "size size 3"], Bool[Tensor, "size size"]]:
    """Return the normals of a field of Gaussian bumps and hollows, orthographic, and a full mask.

    Args:
        size: Of the image.
        generator: On the CPU.
        steepest: Slope.
        count: Of bumps.
    """
    _, slopes = _depth(size, generator, count)
    slopes = slopes * steepest / slopes.norm(dim=-1).max()
    normals = normalize(torch.cat([slopes, -torch.ones_like(slopes[..., :1])], dim=-1), dim=-1)
    return normals, torch.ones(size, size, dtype=torch.bool)


def bumps_in_perspective(
    size: int,
    generator: torch.Generator,
    field_deg: float = 40.0,
    steepest: float = 1.0,
    count: int = 8,
) -> tuple[Float[Tensor, "size size 3"], Bool[Tensor, "size size"], Float[Tensor, "3 3"], Tensor]:
    r"""Return a field of bumps as a pinhole sees it.

    Depth is :math:`z = e^{f(x, y)}` over the normalised image plane; the normal of
    :math:`z\,(x, y, 1)` is along :math:`(f_x, f_y, -1 - x f_x - y f_y)`.

    Args:
        size: Of the image.
        generator: On the CPU.
        field_deg: Angle that the image's width spans.
        steepest: Of the slopes of ``f``.
        count: Of bumps.

    Returns:
        Normals, a full mask, intrinsics, and depth of unit order.
    """
    half = torch.tan(torch.deg2rad(torch.tensor(field_deg / 2, dtype=torch.float64)))
    focal = size / 2 / half
    intrinsics = torch.eye(3, dtype=torch.float64)
    intrinsics[:2] = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]]).double() * focal
    intrinsics[:2, 2] = size / 2
    height, slopes = _depth(size, generator, count)
    scale = steepest / slopes.norm(dim=-1).max()
    # From slopes a unit of half the width to slopes a unit of the image plane.
    slopes, height = slopes * scale, height * scale * half
    xy = (_grid(size) - size / 2) / focal
    last = -1 - (xy * slopes).sum(dim=-1, keepdim=True)
    normals = normalize(torch.cat([slopes, last], dim=-1), dim=-1)
    return normals, torch.ones(size, size, dtype=torch.bool), intrinsics, height.exp()


def regions(
    size: int, generator: torch.Generator, colours: int = 5, seeds: int = 14
) -> Float[Tensor, "size size 3"]:
    """Paint a square image with a few colours, one for each cell of random points.

    Hues are evenly spread and brightness is drawn, so that colours differ in chromaticity.
    """
    points = torch.rand(seeds, 2, generator=generator, dtype=torch.float64) * size
    nearest = (_grid(size)[:, :, None] - points).norm(dim=-1).argmin(dim=-1)
    hue = torch.arange(colours, dtype=torch.float64)[:, None] / colours + torch.arange(3) / 3
    brightness = 0.3 + 0.6 * torch.rand(colours, 1, generator=generator, dtype=torch.float64)
    palette = brightness * (1 + 0.5 * torch.cos(2 * torch.pi * hue)) / 1.5
    return palette[torch.arange(seeds) % colours][nearest]


def _depth(
    size: int, generator: torch.Generator, count: int
) -> tuple[Float[Tensor, "size size"], Float[Tensor, "size size 2"]]:
    """Sum Gaussians on the square from -1 to 1: values and gradient."""
    drawn = torch.rand(4, count, generator=generator, dtype=torch.float64)
    center = 1.8 * drawn[:2].mT - 0.9
    width = 0.25 + 0.35 * drawn[2]
    height = (1 - 2 * (torch.arange(count) % 2)) * (0.5 + drawn[3]) * width
    offset = (_grid(size) * 2 / size - 1)[:, :, None] - center
    value = height * torch.exp(-offset.square().sum(dim=-1) / (2 * width**2))
    return value.sum(dim=-1), -(value / width**2)[..., None].mul(offset).sum(dim=2)


def _grid(size: int) -> Float[Tensor, "size size 2"]:
    return pixel_centers(size, size, torch.zeros(0, dtype=torch.float64))


def align_reliefs(
    shading: Float[Tensor, "3 sample"],
    reference: Float[Tensor, "3 sample"],
    weight: Float[Tensor, " sample"],
) -> BasRelief:
    r"""Find the bas-relief transformation that best aligns one factorization with another.

    Minimises :math:`\sum_k w_k \lVert s G b_k - \bar b_k \rVert^2` over ``G`` and the factor
    ``s``, which is linear in ``s``, ``s lambda``, ``s mu``, ``s nu``.

    Args:
        shading: ``B`` to be aligned, albedo times normal.
        reference: The shading that it is aligned with.
        weight: Not negative.

    Ill-posed where all normals are parallel. Differentiable.
    """
    x, y, z = shading.double()
    w = weight.double()
    square = (w * (x * x + y * y)).sum()
    depth = (w * z * z).sum()
    slant_x, slant_y = (w * x * z).sum(), (w * y * z).sum()
    a, b, c = reference.double()
    # Unknowns s lam, s mu, s nu, s: rows x and y determine the first three, row z the last.
    normal = torch.stack(
        [
            torch.stack([square, -slant_x, -slant_y]),
            torch.stack([-slant_x, depth, torch.zeros_like(depth)]),
            torch.stack([-slant_y, torch.zeros_like(depth), depth]),
        ]
    )
    rhs = torch.stack([(w * (x * a + y * b)).sum(), -(w * z * a).sum(), -(w * z * b).sum()])
    lam, mu, nu = torch.linalg.solve(normal, rhs)
    scale = (w * z * c).sum() / depth
    found = [value / scale for value in (mu, nu, lam)]
    return BasRelief(mu=found[0].to(shading), nu=found[1].to(shading), lam=found[2].to(shading))
