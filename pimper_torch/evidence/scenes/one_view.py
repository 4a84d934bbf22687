r"""One viewpoint under many distant lights, in closed form: the truth of photometric stereo.

Depth is a sum of Gaussian bumps, or a ball's, so its slopes are exact; albedo is one colour a
region. Camera frame: x right, y down, z forward, normals facing the viewer.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class OneView(Record):
    """Photographs from one viewpoint, and what they show.

    Attributes:
        images: Linear radiance, never negative.
        mask: Where the surface is.
        normals: Unit, of the pixels inside the mask in raster order.
        albedo: Of the same pixels.
        lights: Direction times strength.
    """

    images: Float[Tensor, "view channel height width"]
    mask: Bool[Tensor, "height width"]
    normals: Float[Tensor, "3 pixel"]
    albedo: Float[Tensor, "channel pixel"]
    lights: Float[Tensor, "view 3"]

    @property
    def shading(self) -> Float[Tensor, "3 pixel"]:
        """Albedo, summed over channels, times normal."""
        return self.albedo.sum(dim=0) * self.normals


def photograph(
    normals: Float[Tensor, "height width 3"],
    albedo: Float[Tensor, "height width channel"],
    mask: Bool[Tensor, "height width"],
    lights: Float[Tensor, "view 3"],
    generator: torch.Generator,
    noise: float = 0.0,
) -> OneView:
    """Render a Lambertian surface, attached shadows black.

    Args:
        normals: Unit.
        albedo: Linear, not negative.
        mask: Outside it the images are black.
        lights: Direction times strength.
        generator: On the CPU; for the noise.
        noise: Standard deviation of what is added to each value before negative ones are cut
            off, as a fraction of the brightest.
    """
    n, rho = normals[mask].mT, albedo[mask].mT
    values = (lights @ n).clamp_min(0)[:, None] * rho
    drawn = torch.randn(values.shape, generator=generator, dtype=torch.float64).to(values)
    values = (values + noise * values.max() * drawn).clamp_min(0)
    images = values.new_zeros(*values.shape[:2], *mask.shape)
    images[..., mask] = values
    return OneView(images=images, mask=mask, normals=n, albedo=rho, lights=lights)


def ball(
    size: int, rim_deg: float = 75.0
) -> tuple[Float[Tensor, "size size 3"], Bool[Tensor, "size size"]]:
    """Give the normals of a ball that fills a square image, orthographic, and its mask.

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
    """Give the normals of a field of Gaussian bumps and hollows, orthographic, and a full mask.

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
    r"""Give a field of bumps as a pinhole sees it.

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


def point_lights(
    views: int, generator: torch.Generator, widest_deg: float = 50.0
) -> Float[Tensor, "view 3"]:
    """Draw distant point lights evenly over the cap round the view, of strength 0.7 to 1.3."""
    widest = torch.cos(torch.deg2rad(torch.tensor(widest_deg, dtype=torch.float64)))
    drawn = torch.rand(3, views, generator=generator, dtype=torch.float64)
    z = 1 - (1 - widest) * drawn[0]
    angle, radius = 2 * torch.pi * drawn[1], (1 - z * z).sqrt()
    directions = torch.stack([radius * angle.cos(), radius * angle.sin(), -z], dim=1)
    return (0.7 + 0.6 * drawn[2])[:, None] * directions


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
