"""A photograph in a few numbers and a small copy."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.doctor.sharpness import edge_blur_px
from pimper_torch.errors import InputError
from pimper_torch.io.decode import read_header
from pimper_torch.io.header import Header
from pimper_torch.io.photographs import shrunk_focals, shrunk_size
from pimper_torch.io.radiance import read_pictures, resized_radiance
from pimper_torch.parallel import side_by_side
from pimper_torch.radiometry import SATURATED, Encoding
from pimper_torch.records import Record, Views

SMALL_PX = 640  # longer side of the small copy: features of 24 photographs take seconds
_BRIGHT = 0.99  # quantile of radiance that tells the exposure; more are highlights


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Photograph(Record):
    """Measurements of one photograph without its neighbours.

    Attributes:
        width: Pixels, as a run would take them.
        height: Pixels.
        focal_px: By EXIF; NaN where it does not say.
        saturated: Fraction of pixels with a colour that is saturated.
        bright: Radiance that a hundredth of the pixels exceed; 1 is saturation.
        blur_px: Standard deviation of the blur at the strongest edges; NaN where there are none.
        small: Radiance of the small copy, the mean of the colours.
        small_saturated: The highest colour of the small copy.
    """

    name: str
    width: int
    height: int
    focal_px: float
    saturated: float
    bright: float
    blur_px: float
    small: Float[Tensor, "rows columns"]
    small_saturated: Float[Tensor, "rows columns"]


def summarize(
    name: str,
    radiance: Float[Tensor, "channel height width"],
    focal_px: float,
    mask: Bool[Tensor, "height width"] | None = None,
) -> Photograph:
    """Make the numbers and the small copy of linear radiance; saturation counts in the mask."""
    height, width = radiance.shape[-2:]
    shrink = min(1.0, SMALL_PX / max(height, width))
    small = resized_radiance(
        radiance, max(1, round(width * shrink)), max(1, round(height * shrink))
    )
    grey, highest = radiance.mean(dim=0), small.amax(dim=0)
    saturated = radiance.amax(dim=0) >= SATURATED
    counted = saturated if mask is None else saturated[mask]
    return Photograph(
        name=name,
        width=width,
        height=height,
        focal_px=focal_px,
        saturated=float(counted.sum()) / max(1, counted.numel()),
        bright=float(highest.flatten().kthvalue(math.ceil(_BRIGHT * highest.numel())).values),
        blur_px=edge_blur_px(grey),
        small=small.mean(dim=0),
        small_saturated=highest,
    )


def read_all(
    paths: Sequence[Path], encoding: Encoding, max_size_px: int
) -> list[Photograph | InputError]:
    """Read photographs one by one, so that one that cannot be read hides no other.

    Args:
        encoding: As of :func:`pimper_torch.io.photographs.load_views`; saturation that is to be
            found is taken for full scale, as one photograph alone cannot tell it.
    """
    plain = Encoding(
        response=encoding.response,
        saturation=1.0 if encoding.saturation == "auto" else encoding.saturation,
        black=encoding.black,
    )

    def read(path: Path) -> tuple[Photograph, Header] | InputError:
        try:
            header = read_header(path)
            size = shrunk_size(header, max_size_px)
            image = read_pictures([path], [header], [size], plain).images[0]
        except InputError as error:
            return error
        return summarize(path.name, image, math.nan), header

    results = list(side_by_side(read, paths))
    pairs = [result for result in results if not isinstance(result, InputError)]
    sizes = [(photograph.width, photograph.height) for photograph, _ in pairs]
    focals = iter(shrunk_focals([header for _, header in pairs], sizes).tolist())
    return [
        result if isinstance(result, InputError) else result[0].replace(focal_px=next(focals))
        for result in results
    ]


def of_views(views: Views) -> list[Photograph]:
    """Summarize photographs that were read for a run."""

    def one(index: int) -> Photograph:
        width, height = views.sizes_px[index].tolist()
        image = views.images[index, :, :height, :width].detach().cpu().float()
        focal = math.nan if views.focals_px is None else float(views.focals_px[index])
        mask = None if views.masks is None else views.masks[index, :height, :width].cpu()
        return summarize(views.names[index], image, focal, mask)

    with torch.no_grad():
        return list(side_by_side(one, range(views.num_views), tracked=False))
