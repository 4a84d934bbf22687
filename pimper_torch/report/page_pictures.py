"""Photographs and silhouettes as they stand in a page."""

import base64
import math
from io import BytesIO

from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.radiometry import to_bytes

# The demo's 24 photographs and their predictions take 1.1 MB of its page; more photographs share
# the room that so many take. Fewer pixels than the least show nothing.
_LONGEST_PX, _SHORTEST_PX, _VIEWS = 800, 120, 24


def longest_px(num_views: int) -> int:
    """Return the longer side of every photograph in a page of so many."""
    return round(max(_SHORTEST_PX, _LONGEST_PX * min(1.0, math.sqrt(_VIEWS / num_views))))


def shrunk(
    picture: Float[Tensor, "channel height width"], longest: int
) -> Float[Tensor, "channel shorter narrower"]:
    """Average a picture down until its longer side is ``longest`` pixels; small ones stay."""
    height, width = picture.shape[-2:]
    factor = min(1.0, longest / max(height, width))
    size = (max(1, round(factor * height)), max(1, round(factor * width)))
    return interpolate(picture[None], size=size, mode="area")[0]


def jpeg(radiance: Float[Tensor, "channel height width"]) -> str:
    """Return a picture of linear radiance, cut off at 1, as a data address of a JPEG."""
    colors = to_bytes(radiance.detach().cpu().clamp(0, 1).movedim(0, -1)).expand(-1, -1, 3)
    file = BytesIO()
    Image.fromarray(colors.numpy()).save(file, "JPEG", quality=80)
    return f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"


def outline(inside: Float[Tensor, "height width"], scale: float) -> str:
    """Trace the border of a silhouette as a path of SVG.

    Args:
        scale: Pixels of the photograph to one of ``inside``.
    """
    # Local: scipy's image functions take long to import.
    from skimage.measure import approximate_polygon, find_contours

    values = inside.detach().float().cpu().numpy()
    lines = [approximate_polygon(line, 0.7) for line in find_contours(values, 0.5)]
    return "".join(
        "M" + "L".join(f"{scale * (x + 0.5):.0f} {scale * (y + 0.5):.0f}" for y, x in line)
        for line in lines
        if len(line) > 2
    )
