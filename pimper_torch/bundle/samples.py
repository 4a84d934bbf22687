"""The samples that cameras are adjusted to, and what each view should show there."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from kornia.geometry.transform import pyrdown
from torch import Tensor

from pimper_torch.geometry.frames import invert_rigid, transform
from pimper_torch.geometry.projection import project
from pimper_torch.patches.pyramid import sample_pyramid
from pimper_torch.photometry.manifolds import Cone, Manifold, SecondOrder
from pimper_torch.radiometry import SATURATED
from pimper_torch.records import (
    Cameras,
    PatchViews,
    PhotometricPatches,
    Photometry,
    Record,
    Templates,
    Views,
)

MANIFOLDS: dict[int, Manifold] = {4: Cone(), 9: SecondOrder()}

# torch draws from at most so many at once.
_MOST_CANDIDATES = 2**24 - 1

# Views that must show a sample: with two, albedo explains one of them.
_LEAST_VIEWS = 3


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Samples(Record):
    """Places on the surface, with what light and normal make of them.

    Attributes:
        facet: That each lies on.
        points_world: Of the sample, of its right and of its lower neighbour: the two sides of
            what it covers.
        shading: ``l . (1, n)``: the radiance of albedo 1 in every view.
        albedo: Gray.
        seen: True where a view has the sample.
    """

    facet: Int[Tensor, " sample"]
    points_world: Float[Tensor, "sample 3 3"]
    shading: Float[Tensor, "sample view"]
    albedo: Float[Tensor, " sample"]
    seen: Bool[Tensor, "sample view"]

    def take(self, chosen: Bool[Tensor, " sample"]) -> "Samples":
        """Keep some samples."""
        return Samples(
            facet=self.facet[chosen],
            points_world=self.points_world[chosen],
            shading=self.shading[chosen],
            albedo=self.albedo[chosen],
            seen=self.seen[chosen],
        )


def choose_samples(
    seen: PatchViews,
    found: PhotometricPatches,
    count: int,
    min_confidence: float,
    generator: torch.Generator,
) -> Samples:
    """Draw samples on the facets themselves, the rather the more texture they carry.

    Args:
        seen: Which views have which samples.
        found: Their photometry.
        count: At most.
        min_confidence: Of the photometry.
        generator: On the CPU; for the draw.
    """
    scores, places = [], []
    for number, (templates, registered, photometry) in enumerate(
        zip(seen.patches.buckets, seen.buckets, found.buckets, strict=True)
    ):
        enough = registered.valid.sum(dim=1) >= _LEAST_VIEWS
        wanted = enough & photometry.valid & (photometry.confidence >= min_confidence)
        wanted = wanted & (templates.barycentric >= 0).all(dim=-1)
        patch, row, column = wanted.nonzero(as_tuple=True)
        score = texture(photometry)[patch, row, column] * photometry.confidence[patch, row, column]
        scores.append(score.detach().cpu().double())
        places.append(
            torch.stack([torch.full_like(patch, number), patch, row, column], dim=1).cpu()
        )
    score, place = torch.cat(scores), torch.cat(places)
    stride = -(-len(score) // _MOST_CANDIDATES) if len(score) else 1
    score, place = score[::stride], place[::stride]
    possible = int((score > 0).sum())
    if possible > count:
        drawn = torch.multinomial(score, count, generator=generator).sort().values
    else:
        (drawn,) = torch.nonzero(score > 0, as_tuple=True)
    chosen = place[drawn]
    parts = []
    for number, (templates, registered, photometry) in enumerate(
        zip(seen.patches.buckets, seen.buckets, found.buckets, strict=True)
    ):
        here = chosen[chosen[:, 0] == number, 1:].to(templates.facet.device)
        parts.append(_gathered(templates, registered.valid, photometry, here))
    return Samples(
        **{
            name: torch.cat([getattr(part, name) for part in parts])
            for name in ("facet", "points_world", "shading", "albedo", "seen")
        }
    )


def texture(photometry: Photometry) -> Float[Tensor, "patch height width"]:
    """Give how much gray albedo changes from a sample to the next, as a share of itself."""
    gray = photometry.albedo.mean(dim=-1)
    known = photometry.valid
    change = torch.zeros_like(gray)
    for dim in (1, 2):
        size = gray.shape[dim] - 1
        step = gray.diff(dim=dim).abs()
        both = known.narrow(dim, 0, size) & known.narrow(dim, 1, size)
        change.narrow(dim, 0, size).add_((step * both).square())
    return change.sqrt() / torch.where(gray > 0, gray, torch.inf)


def _gathered(
    templates: Templates,
    valid: Bool[Tensor, "patch view height width"],
    photometry: Photometry,
    place: Int[Tensor, "sample 3"],
) -> Samples:
    patch, row, column = place.unbind(dim=1)
    height, width = templates.depth.shape[1:]
    # At the far border the neighbour on the other side spans as much.
    right = torch.where(column + 1 < width, column + 1, (column - 1).clamp_min(0))
    down = torch.where(row + 1 < height, row + 1, (row - 1).clamp_min(0))
    raster = templates.points_patch.detach().double()
    corners = torch.stack(
        [raster[patch, row, column], raster[patch, row, right], raster[patch, down, column]], dim=1
    )
    world_from_patch = invert_rigid(templates.patch_from_world.double())
    normals = photometry.normals_patch[patch, row, column].detach().double()
    lights = photometry.lights_patch[patch].detach().double()
    manifold = MANIFOLDS[lights.shape[-1]]
    basis = manifold.join(torch.ones_like(normals[:, 0]), normals)
    shading = (lights @ basis[..., None])[..., 0]
    return Samples(
        facet=templates.facet[patch],
        points_world=transform(world_from_patch[patch], corners),
        shading=shading,
        albedo=photometry.albedo[patch, row, column].detach().double().mean(dim=-1),
        seen=valid[patch, :, row, column] & (shading > 0),
    )


def gray_pyramid(views: Views, levels: int) -> list[Float[Tensor, "view 2 _ _"]]:
    """Halve the photographs again and again: gray, and the share of unusable pixels."""
    finite = views.images.isfinite().all(dim=1)
    usable = views.inside & finite & (views.images.amax(dim=1) < SATURATED)
    if views.masks is not None:
        usable = usable & views.masks
    gray = torch.where(finite, views.images.mean(dim=1), 0)
    found = [torch.stack([gray, (~usable).to(gray)], dim=1).detach()]
    while len(found) < levels and min(found[-1].shape[-2:]) >= 8:
        found.append(pyrdown(found[-1]))
    return found


def look_up(
    pyramid: list[Float[Tensor, "view 2 _ _"]],
    view: int,
    pixels: Float[Tensor, "sample 2"],
    level: Float[Tensor, " sample"],
) -> tuple[Float[Tensor, " sample"], Float[Tensor, "sample 2"], Bool[Tensor, " sample"]]:
    """Give a view's radiance at pixels, its slope there, and whether it can be used."""
    with torch.enable_grad():
        where = pixels.detach().requires_grad_()
        images = [each[view] for each in pyramid]
        found = sample_pyramid(images, where[None, None], level[None, None])[0, :, 0]
        (slope,) = torch.autograd.grad(found[0].sum(), where)
    height, width = pyramid[0].shape[-2:]
    inside = (pixels > 0).all(dim=1) & (pixels < pixels.new_tensor([width, height])).all(dim=1)
    usable = inside & (found[1].detach() < 0.1)
    return found[0].detach().to(pixels), slope.to(pixels), usable


def footprint_levels(samples: Samples, cameras: Cameras) -> Float[Tensor, "view sample"]:
    """Choose the pyramid level at which a sample covers a pixel, as registration does."""
    pixels, _ = project(
        samples.points_world.reshape(1, -1, 3),
        cameras.cam_from_world.double(),
        cameras.intrinsics.double(),
    )
    corners = pixels.reshape(len(pixels), -1, 3, 2)
    right, down = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
    area = (right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]).abs()
    return 0.5 * area.clamp_min(1).log2()
