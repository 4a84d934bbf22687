r"""Groups of pixels of one paint, by their chromaticity in all photographs.

A Lambertian pixel's channels differ by albedo and by the point light's colour alone: shading,
shadow and normal multiply all of them. In logarithm :math:`\log J_{vci} = s_{vi} + e_{vc} +
a_{ci}`, with ``e`` the colour of the light of view v and ``a`` that of pixel i.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.errors import InputError

# Channels darker than this fraction of a photograph's brightest value are ignored: a choice.
_DARK = 0.02
# Alternations between lights and pixels: a choice; each at least halves the residual where point
# lights overlap.
_ALTERNATIONS = 20
# Pixels that are clustered; all are then assigned: a choice.
_CLUSTERED = 2000


def chromaticities(
    images: Float[Tensor, "view channel height width"], mask: Bool[Tensor, "height width"]
) -> tuple[Float[Tensor, "channel pixel"], Bool[Tensor, " pixel"]]:
    r"""Estimate the logarithm of each pixel's chromaticity, the lights' colours removed.

    Weighted least squares for ``e`` and ``a`` in turn, weights the square of brightness: the
    noise of a logarithm is that of the value over the value.

    Args:
        images: Linear radiance.
        mask: Pixels to use, in raster order.

    Returns:
        Colours whose sum over channels is zero, up to one colour that all pixels share; and
        whether a pixel has one: bright enough in all channels of some view.
    """
    values = images[:, :, mask].double()
    brightest = values.flatten(1).amax(dim=1)[:, None]
    bright = values.amin(dim=1) > _DARK * brightest
    log = torch.where(bright[:, None], values, 1).log()
    log = log - log.mean(dim=1, keepdim=True)
    # Harmonic: the darkest channel has the noisiest logarithm.
    inverse = torch.where(bright[:, None], values, 1).pow(-2).sum(dim=1)
    weight = (bright / inverse)[:, None]
    total_view = weight.sum(dim=2).clamp_min(1e-30)
    total_pixel = weight.sum(dim=0).clamp_min(1e-30)
    point_light = torch.zeros_like(log[:, :, 0])
    pixel = torch.zeros_like(log[0])
    for _ in range(_ALTERNATIONS):
        pixel = (weight * (log - point_light[..., None])).sum(dim=0) / total_pixel
        point_light = (weight * (log - pixel)).sum(dim=2) / total_view
    return pixel.to(images), bright.any(dim=0)


def chromaticity_groups(
    images: Float[Tensor, "view channel height width"],
    mask: Bool[Tensor, "height width"],
    *,
    radius: float = 0.05,
    smallest: float = 0.01,
) -> Int[Tensor, " pixel"]:
    """Cluster pixels of similar chromaticity.

    The colour with the most neighbours becomes the first cluster, its neighbours are removed, and
    so on; then every pixel is assigned to the nearest cluster within the radius. Colours that
    change smoothly give arbitrary clusters.

    Args:
        images: Linear radiance, of two channels or more.
        mask: Pixels to use, in raster order.
        radius: In logarithm of colour; a few times its noise, less than half the distance of
            different paints.
        smallest: Groups with less than this fraction of the pixels are dropped.

    Returns:
        Labels from 0, the largest group's; -1 for pixels in no group.
    """
    if images.shape[1] < 2:
        raise InputError(
            f"images have {images.shape[1]} channel; needed: two at least, pixels of one paint "
            "are grouped by colour. Use another method for grey images."
        )
    colour, known = chromaticities(images, mask)
    labels = torch.full_like(known, -1, dtype=torch.int64)
    if not bool(known.any()):
        raise InputError("no pixel inside the mask is bright in all channels; needed: some.")
    colour = colour[:, known].mT.double().contiguous()
    sample = colour[:: -(-len(colour) // _CLUSTERED)]
    neighbours = torch.cdist(sample, sample) < radius
    remaining = torch.ones(len(sample), dtype=torch.bool, device=sample.device)
    leaders = []
    while bool(remaining.any()):
        votes = (neighbours & remaining).sum(dim=1) * remaining
        best = int(votes.argmax())
        if int(votes[best]) < max(2, smallest * len(sample)):
            break
        leaders.append(sample[neighbours[best] & remaining].mean(dim=0))
        remaining = remaining & ((sample - leaders[-1]).norm(dim=1) > 2 * radius)
    if leaders:
        distance, nearest = torch.cdist(colour, torch.stack(leaders)).min(dim=1)
        labels[known] = torch.where(distance < radius, nearest, -1)
    return labels
