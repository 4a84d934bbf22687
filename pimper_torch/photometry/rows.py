"""Gather the samples inside templates from rasters into rows, and scatter them back."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from pimper_torch.records import Observations, Record, Templates


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Rows(Record):
    """The samples inside each patch's template, flattened and padded to the longest.

    Attributes:
        index: Of each sample in the flattened raster; padding indexes samples outside
            the template.
        radiance: Linear; zero where missing.
        seen: ``D``; false where radiance is not finite.
        normals: Initial normals of the template, patch frame.
    """

    index: Int[Tensor, "patch sample"]
    radiance: Float[Tensor, "patch view channel sample"]
    seen: Bool[Tensor, "patch view sample"]
    normals: Float[Tensor, "patch sample 3"]

    def only(self, some: Bool[Tensor, "patch view sample"]) -> "Rows":
        """Take all others as missing."""
        seen = self.seen & some
        return self.replace(seen=seen, radiance=torch.where(seen[:, :, None], self.radiance, 0))


def rows_of(
    templates: Templates, registered: Observations, normals: Float[Tensor, "patch height width 3"]
) -> Rows:
    """Gather the samples inside each template."""
    inside = templates.inside.flatten(1)
    longest = max(int(inside.sum(dim=1).max()), 1) if len(inside) else 1
    index = torch.argsort((~inside).to(torch.uint8), dim=1, stable=True)[:, :longest]
    within = inside.gather(1, index)
    num_views, num_channels = registered.radiance.shape[1:3]
    by_channel = index[:, None, None].expand(-1, num_views, num_channels, -1)
    radiance = registered.radiance.flatten(3).gather(3, by_channel)
    seen = in_row(registered.valid, index) & within[:, None]
    # A sum is finite where all its terms are, but for overflow.
    seen = seen & radiance.sum(dim=2).isfinite()
    return Rows(
        index=index,
        radiance=torch.where(seen[:, :, None], radiance, 0),
        seen=seen,
        normals=normals.flatten(1, 2).gather(1, index[..., None].expand(-1, -1, 3)),
    )


def in_row(
    raster: Shaped[Tensor, "patch view height width"], index: Int[Tensor, "patch sample"]
) -> Shaped[Tensor, "patch view sample"]:
    """Take the samples of a row from their rasters."""
    flat = raster.flatten(2)
    return flat.gather(2, index[:, None].expand(-1, flat.shape[1], -1))


def on_raster(
    row: Float[Tensor, "patch sample *channel"] | Bool[Tensor, "patch sample"],
    index: Int[Tensor, "patch sample"],
    background: Float[Tensor, "patch height width *channel"] | Bool[Tensor, "patch height width"],
) -> Float[Tensor, "patch height width *channel"] | Bool[Tensor, "patch height width"]:
    """Scatter a row to its raster, over a background."""
    expanded = index if row.ndim == 2 else index[..., None].expand_as(row)
    return background.flatten(1, 2).scatter(1, expanded, row).reshape(background.shape)
