"""The supporting plane's albedo, and its light and level of shadow in every view.

In log radiance a pixel of the plane is albedo plus light, or a level lower in cast shadow. Light is
a quadratic function on the plane; views vote on the albedo.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool1d

from pimper_torch.geometry.opencv import warped, window_means
from pimper_torch.geometry.pixels import homogeneous, pixel_centers
from pimper_torch.geometry.supporting_plane import Fixation, Plane
from pimper_torch.records import Record
from pimper_torch.records.shapes import Map, Masks, PerView
from pimper_torch.stages.silhouettes.parallax import (
    Raster,
    WorkingPictures,
    in_front,
    of_views,
    plane_raster,
)

# Half the raster's side, of the cameras' distance, and working pixels between its samples. On half
# of this, object and shadow fill the raster and the fit of light fails.
_REACH, _STEP = 0.8, 3.0
_ITERATIONS = 6
_SHADOWED = -0.35  # log radiance less that of the lit plane; brighter pixels are lit
_NEAR_FOOT = 0.44  # of the raster's half side: where cast shadows are looked for
_USUAL_SHADOW, _SPREAD = -1.3, 0.6  # of soft lamps; and of the views around their median
# A view supports an albedo if it is lit or shadowed by less than these; the second counts less.
_LIT, _DARK, _DARK_WEIGHT = 0.2, 0.25, 0.6
_BINS = 96  # of log albedo
_ENOUGH = 4.5  # views whose support makes an albedo certain
_CHUNK = 2**22  # samples


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class LitPlane(Record):
    """Appearance of the supporting plane.

    Attributes:
        albedo: Logarithm, on the raster; NaN where fewer than three views see the plane.
        support: Certainty of the albedo, from 0 to 1.
        light: Coefficients of each view's log light, a quadratic function on the raster.
        shadow: Log radiance in cast shadow less that of the lit plane.
    """

    raster: Raster
    albedo: Float[Tensor, "row column"]
    support: Float[Tensor, "row column"]
    light: Float[Tensor, "view 6"]
    shadow: PerView

    def residual(self, view: int, grey: Map) -> Float[Tensor, "2 height width"]:
        """Return a view's log radiance less that of the lit plane, and the albedo's support.

        Both are 0 where the plane is unknown.
        """
        height, width = grey.shape
        to = torch.linalg.inv(self.raster.pixels_from_raster[view])
        layers = [warped(layer, to, (width, height)) for layer in (self.albedo, self.support)]
        albedo, support = (in_front(layer, to) for layer in layers)
        places = homogeneous(pixel_centers(width, height, like=grey)) @ to.mT
        scaled = _scaled(places[..., :2] / places[..., 2:], self.raster)
        residual = grey - _quadratic(scaled) @ self.light[view] - albedo
        known = residual.isfinite() & support.isfinite()
        return torch.stack([residual, support]).masked_fill(~known, 0)


def lit_plane(
    pictures: WorkingPictures, plane: Plane, fixation: Fixation, hidden: Masks | None = None
) -> LitPlane:
    """Estimate the plane's albedo, and light and shadow of each view.

    Args:
        hidden: Pixels that are known not to show the plane.
    """
    raster = plane_raster(pictures.cameras, plane, fixation, _REACH, _STEP)
    grey = window_means(pictures.grey, 3)

    def rectified(view: int) -> Float[Tensor, "row column"]:
        shown = grey[view]
        if hidden is not None:
            shown = shown.masked_fill(hidden[view], torch.nan)
        return warped(shown, raster.pixels_from_raster[view], raster.size_px)

    stack = of_views(rectified, len(grey))
    columns, rows = raster.size_px
    places = _scaled(pixel_centers(columns, rows, like=grey), raster)
    light = _light(stack[:, ::2, ::2].flatten(1), _quadratic(places[::2, ::2]).flatten(0, 1))
    basis = _quadratic(places).flatten(0, 1)
    lit = stack.flatten(1)
    for values, coefficients in zip(lit, light, strict=True):
        values -= basis @ coefficients
    near = (places.norm(dim=-1) < _NEAR_FOOT).flatten()
    shadow = _shadow_levels(lit[:, near] - _quantile(lit[:, near], 0.5))
    known = lit[lit.isfinite()][:: max(1, lit.numel() // 100_000)]
    ends = torch.quantile(known, torch.tensor([0.005, 0.995])) if len(known) else torch.zeros(2)
    size = max(1, _CHUNK // len(lit))
    chunks = [_albedo(part, shadow, ends) for part in torch.split(lit, size, dim=1)]
    albedo, support = torch.cat(chunks, dim=1).reshape(2, rows, columns)
    return LitPlane(raster=raster, albedo=albedo, support=support, light=light, shadow=shadow)


def _scaled(places: Float[Tensor, "*batch 2"], raster: Raster) -> Float[Tensor, "*batch 2"]:
    """Return positions on the raster between -1 and 1."""
    return 2 * places / places.new_tensor(raster.size_px) - 1


def _quadratic(places: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 6"]:
    x, y = places.unbind(dim=-1)
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=-1)


def _quantile(values: Float[Tensor, "view place"], fraction: float) -> Float[Tensor, " place"]:
    """Return a quantile over the views that are not NaN; NaN if these are fewer than three."""
    count = values.isfinite().sum(dim=0)
    index = (fraction * (count - 1).clamp_min(0)).round().long()
    ordered = values.sort(dim=0).values.gather(0, index[None])[0]  # NaN comes last
    return ordered.masked_fill(count < 3, torch.nan)


def _light(
    grey: Float[Tensor, "view place"], basis: Float[Tensor, "place 6"]
) -> Float[Tensor, "view 6"]:
    """Fit each view's light by reweighted least squares, in turns with the albedo.

    The albedo is a high quantile of the views at first, since shadows only darken.
    """
    light = grey.new_zeros(len(grey), 6)
    damping = 1e-3 * torch.eye(6)
    for iteration in range(_ITERATIONS):
        fraction = 0.6 if iteration < _ITERATIONS - 1 else 0.5
        lit = light @ basis.mT
        target = grey - _quantile(grey - lit, fraction)
        residual = target - lit
        spread = 1.48 * residual.abs().nanmedian(dim=1, keepdim=True).values
        scale = (0.7**iteration * spread).nan_to_num(0.05).clamp_min(0.05)
        weight = (1 + (residual / scale) ** 2).pow(-2).nan_to_num(0)
        normal = torch.einsum("vp,pi,pj->vij", weight, basis, basis)
        right = (weight * target.nan_to_num(0)) @ basis
        total = weight.sum(dim=1).clamp_min(1)[:, None, None]
        light = torch.linalg.solve(normal / total + damping, right / total[:, 0])
    return light


def _shadow_levels(residual: Float[Tensor, "view place"]) -> PerView:
    """Return the mode of each view's shadowed residuals, near the views' median."""
    low, bins = -3.5, 32
    width = (_SHADOWED - low) / bins
    levels = residual.new_full((len(residual),), torch.nan)
    for view, values in enumerate(residual):
        shadowed = values[values < _SHADOWED]
        if len(shadowed) > 0.005 * len(values):
            index = ((shadowed - low) / width).long().clamp(0, bins - 1)
            counts = torch.bincount(index, minlength=bins).float()
            smooth = avg_pool1d(counts[None], 3, 1, 1)[0]
            levels[view] = low + width * (float(smooth.argmax()) + 0.5)
    median = float(levels.nanmedian().nan_to_num(_USUAL_SHADOW))
    return levels.nan_to_num(median).clamp(median - _SPREAD, median + _SPREAD)


def _albedo(
    lit: Float[Tensor, "view place"], shadow: PerView, ends: Float[Tensor, "2"]
) -> Float[Tensor, "2 place"]:
    """Return the log albedo that most views support, lit or in shadow, and its certainty.

    Args:
        lit: Log radiance less the light.
        ends: Least and greatest log albedo.
    """
    seen = lit.isfinite()
    values = lit.nan_to_num(0)
    dark, low = values - shadow[:, None], float(ends[0])
    width = max((float(ends[1]) - low) / _BINS, 1e-3)
    votes = values.new_zeros(lit.shape[1], _BINS)
    for level, weight in ((values, 1.0), (dark, _DARK_WEIGHT)):
        index = ((level - low) / width).long()
        valid = seen & (index >= 0) & (index < _BINS)
        votes.scatter_add_(1, index.clamp(0, _BINS - 1).mT, weight * valid.mT.to(votes))
    wide = 2 * max(1, round(_LIT / width)) + 1
    support = avg_pool1d(votes, wide, 1, wide // 2) * wide
    best = low + width * (support.argmax(dim=1) + 0.5)
    near = seen * ((values - best).abs() < _LIT), seen * ((dark - best).abs() < _DARK)
    weights = near[0].float(), _DARK_WEIGHT * near[1] * ~near[0]
    total = weights[0].sum(dim=0) + weights[1].sum(dim=0)
    mean = (weights[0] * values + weights[1] * dark).sum(dim=0) / total
    certain = ((total - 2.5) / (_ENOUGH - 2.5)).clamp(0, 1)
    return torch.stack([mean, certain]).masked_fill(seen.sum(dim=0) < 3, torch.nan)
