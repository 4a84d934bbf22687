"""What OpenCV computes on masks and photographs. The only importer of ``cv2``."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor


def signed_distance(mask: Bool[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Give each pixel's distance to the border of a mask in pixels, positive inside.

    The border runs midway between the centres of unlike neighbours. Where nothing is masked,
    or all is, the distance is minus or plus the sum of the sides.
    """
    drawn = mask.cpu().numpy().astype(np.uint8)
    far = float(sum(drawn.shape))
    if drawn.all() or not drawn.any():
        return torch.full(mask.shape, far if drawn.all() else -far, device=mask.device)
    inner, outer = (
        cv2.distanceTransform(side, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        for side in (drawn, 1 - drawn)
    )
    signed = np.where(drawn > 0, inner - 0.5, 0.5 - outer)
    return torch.from_numpy(signed.astype(np.float32)).to(mask.device)
