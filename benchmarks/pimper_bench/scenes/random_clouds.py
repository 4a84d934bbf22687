"""Sparse clouds with points only where photographs have texture, as detectors find them."""

import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.scenes.random_draws import Draws
from pimper_bench.scenes.true_clouds import tracked, triangulated
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.records import Cameras, SparseScene, Views

_WINDOW_PX = 7
# Standard deviation of log radiance below which nothing is detected, and above which all is.
_FAINTEST, _STRONGEST = 0.02, 0.15
_SHADING = 0.2  # probability that contrast without texture is matched
_DARK = 0.01  # added before the logarithm: noise hides weaker differences
_NOISE_PX, _OUTLIERS = 0.3, 0.02
_FEWEST, _MOST = 300, 3000  # points
_GAINS = (1.0, 4.0, 16.0)  # factors on the probabilities, tried in turn until points suffice


def detectability(
    image: Float[Tensor, "channel height width"],
    albedo: Float[Tensor, "channel height width"],
    surface: Int[Tensor, "height width"],
) -> Float[Tensor, "height width"]:
    """Return the probability that a feature is detected at each pixel, and again elsewhere.

    It grows with the contrast of the photograph, and is a fifth without contrast of albedo: edges
    of shadows move with the light.

    Args:
        image: Linear radiance without noise.
        surface: A number for each surface, across whose outlines nothing is compared.
    """
    clear = whole_windows(surface)
    visible, lasting = (
        ((local_contrast(values, clear) - _FAINTEST) / (_STRONGEST - _FAINTEST)).clamp(0, 1)
        for values in (image, albedo)
    )
    return visible * (_SHADING + (1 - _SHADING) * (2 * lasting).clamp_max(1))


def whole_windows(surface: Int[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Return the pixels around which a window is on one surface and inside the image."""
    numbers = surface.numpy().astype("int8")
    lowest = minimum_filter(numbers, _WINDOW_PX, mode="constant", cval=-2)
    highest = maximum_filter(numbers, _WINDOW_PX, mode="constant", cval=-2)
    return torch.from_numpy(lowest == highest)


def local_contrast(
    image: Float[Tensor, "channel height width"], clear: Bool[Tensor, "height width"]
) -> Float[Tensor, "height width"]:
    """Return the standard deviation of log radiance in a window around each pixel.

    Slow changes are removed first: shading is no texture.

    Args:
        clear: Pixels whose windows are on one surface; the contrast is that of these pixels, and
            0 around which they are less than a third of a window.
    """
    logarithm = (image.mean(dim=0).clamp(0, 1) + _DARK).log()
    detail = torch.where(clear, logarithm - _window_mean(logarithm), 0)
    share = _window_mean(clear.to(logarithm))
    mean, square = (_window_mean(values) / share.clamp_min(1e-3) for values in (detail, detail**2))
    return torch.where(share > 1 / 3, (square - mean**2).clamp_min(0).sqrt(), 0)


def _window_mean(values: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    return torch.from_numpy(uniform_filter(values.numpy(), _WINDOW_PX, mode="constant"))


def textured_cloud(
    views: Views,
    cameras: Cameras,
    depth: Float[Tensor, "view height width"],
    chance: Float[Tensor, "view height width"],
    draws: Draws,
) -> SparseScene:
    """Draw features in the photographs, track and triangulate them; float32.

    300 to 3000 points, fewer without texture for them, with 0.3 px of noise; 2 % are wrong.

    Args:
        depth: Along the camera's z; infinite where nothing can be tracked.
        chance: Probability that a feature is detected at each pixel.
    """
    count = round(draws.log_uniform(_FEWEST / (1 - _OUTLIERS) + 1, _MOST))
    wrong = round(_OUTLIERS * count)
    for gain in _GAINS:
        likely = (gain * chance).clamp_max(1)
        points, anchors = _features(cameras, depth, likely, 10 * count, draws)
        pixels, seen = tracked(cameras, depth, points)
        seen &= _matched(cameras, points, pixels, anchors, likely, draws)
        (kept,) = torch.nonzero(seen.sum(dim=1) >= 3, as_tuple=True)
        kept = kept[: count - wrong]
        if len(kept) >= _FEWEST:
            break
    wrong = wrong if len(kept) else 0
    false_points, false_pixels, false_seen = _outliers(cameras, points[kept], wrong, draws)
    return triangulated(
        views,
        cameras,
        torch.cat([points[kept], false_points]),
        torch.cat([pixels[kept], false_pixels]),
        torch.cat([seen[kept], false_seen]),
        draws.generator,
        noise_px=_NOISE_PX,
    )


def _features(
    cameras: Cameras,
    depth: Float[Tensor, "view height width"],
    chance: Float[Tensor, "view height width"],
    count: int,
    draws: Draws,
) -> tuple[Float[Tensor, "point 3"], Int[Tensor, " point"]]:
    """Draw pixels by their chance, and return their points in random order, and their views."""
    detected = draws.vector(0, 1, *depth.shape) < torch.where(depth.isfinite(), chance, 0)
    rows = torch.nonzero(detected)
    rows = rows[torch.randperm(len(rows), generator=draws.generator)[:count]]
    view, v, u = rows.unbind(dim=1)
    width, height = (int(side) for side in cameras.sizes_px[0])
    centers = pixel_centers(width, height, like=cameras.intrinsics)[v, u]
    rays = rays_through(centers[:, None], cameras.cam_from_world[view], cameras.intrinsics[view])
    along = depth[view, v, u].to(rays)[:, None] * rays[:, 0]
    return cameras.centers_world[view] + along, view


def _matched(
    cameras: Cameras,
    points: Float[Tensor, "point 3"],
    pixels: Float[Tensor, "point view 2"],
    anchors: Int[Tensor, " point"],
    chance: Float[Tensor, "view height width"],
    draws: Draws,
) -> Bool[Tensor, "point view"]:
    """Draw the views that detect each point again, up to an angle from its first view."""
    count, num_views = len(points), cameras.num_views
    height, width = chance.shape[1:]
    u = pixels[..., 0].floor().long().clamp(0, width - 1)
    v = pixels[..., 1].floor().long().clamp(0, height - 1)
    there = chance[torch.arange(num_views), v, u]
    # The window's contrast at the first view has been drawn; the rest is up to each feature.
    distinct = draws.vector(0.3, 1.0, count, 1)
    again = draws.vector(0, 1, count, num_views) < distinct * there.sqrt()
    toward = normalize(cameras.centers_world - points[:, None], dim=-1)
    first = toward[torch.arange(count), anchors][:, None]
    widest = torch.deg2rad(draws.vector(30, 65, count, 1))
    near = (toward * first).sum(dim=-1) > widest.cos()
    return (again & near).index_put((torch.arange(count), anchors), torch.tensor(True))


def _outliers(
    cameras: Cameras, points: Float[Tensor, "point 3"], count: int, draws: Draws
) -> tuple[Float[Tensor, "wrong 3"], Float[Tensor, "wrong view 2"], Bool[Tensor, "wrong view"]]:
    """Draw wrong points near the scene, each observed in three photographs."""
    if count == 0:
        none = points.new_zeros(0, cameras.num_views)
        return points[:0], none[..., None].expand(-1, -1, 2), none.bool()
    middle = points.median(dim=0).values
    reach = 1.5 * (points - middle).norm(dim=1).quantile(0.8)
    drawn = middle + reach * draws.vector(-1, 1, 20 * count, 3)
    pixels, depth = project(drawn, cameras.cam_from_world, cameras.intrinsics)
    size = cameras.sizes_px[:, None].to(pixels)
    framed = ((depth > 0.1 * reach) & ((pixels > 1) & (pixels < size - 1)).all(dim=-1)).mT
    order = torch.where(framed, draws.vector(0, 1, *framed.shape), -1)
    chosen = torch.zeros_like(framed).scatter(1, order.topk(3, dim=1).indices, True)
    (kept,) = torch.nonzero((framed & chosen).sum(dim=1) == 3, as_tuple=True)
    kept = kept[:count]
    return drawn[kept], pixels.movedim(0, 1)[kept], chosen[kept]
