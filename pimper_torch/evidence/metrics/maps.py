"""Figures for maps of one view, under the names that benchmarks of such maps use."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.errors import InputError
from pimper_torch.evidence.metrics.relative import angles_deg

DepthAlignment = Literal["none", "median scale", "median offset"]


def mean_angular_error_deg(
    normals: Float[Tensor, "height width 3"],
    normals_true: Float[Tensor, "height width 3"],
    mask: Bool[Tensor, "height width"],
) -> float:
    """Return DiLiGenT's MAE: the mean angle between normals over all pixels of the mask.

    Both maps are in one frame. A pixel of the mask that the estimate leaves without a normal
    (zero or not finite) counts as 90 degrees off, so that no method gains by silence.

    Raises:
        InputError: The mask is empty, or a pixel of it has no true normal.

    Source: Shi et al., PAMI 41(2), 2019; the rule for silent pixels is ours, for the
    published code has none.
    """
    if not bool(mask.any()):
        raise InputError("the mask is empty; needed: pixels on the object.")
    truth, ours = normals_true[mask].double(), normals[mask].double()
    unknown = ~(truth.norm(dim=1) > 0)
    if bool(unknown.any()):
        raise InputError(
            f"{int(unknown.sum())} of {len(truth)} pixels in the mask have no true normal; needed: "
            "one at every pixel. Leave them out of the mask."
        )
    there = ours.isfinite().all(dim=1) & (ours.norm(dim=1) > 0)
    angles = angles_deg(normalize(ours, dim=1), normalize(truth, dim=1))
    return float(torch.where(there, angles, 90.0).mean())


def mean_absolute_depth_error(
    depth: Float[Tensor, "height width"],
    depth_true: Float[Tensor, "height width"],
    alignment: DepthAlignment,
    mask: Bool[Tensor, "height width"] | None = None,
) -> float:
    """Return MADE, the mean absolute error of integrated depth, in units of the true depth.

    Integration leaves one number open, which the alignment fixes by a median, as it is
    published: of the ratios ``true / estimated`` under perspective projection
    (``median scale``), where depth is known up to scale; of the differences under
    orthographic projection (``median offset``), where it is known up to a constant.

    Args:
        depth: Of the estimate; NaN or infinite where there is none.
        mask: Where to compare; wherever both are known, if not given.

    Raises:
        InputError: No pixel has both, or, for ``median scale``, a depth is not positive.

    Source: for the scale, Cao et al., ECCV 2022, and their published evaluation.
    """
    valid = depth.isfinite() & depth_true.isfinite()
    if mask is not None:
        valid = valid & mask
    if not bool(valid.any()):
        raise InputError("no pixel has both an estimated and a true depth to compare.")
    ours, truth = depth[valid].cpu().double(), depth_true[valid].cpu().double()
    if alignment == "median scale":
        if not (bool((ours > 0).all()) and bool((truth > 0).all())):
            raise InputError(
                "some depths are not positive, so no scale aligns them; needed: depths in front "
                "of the camera, or the alignment `median offset`."
            )
        ours = ours * float(np.median((truth / ours).numpy()))
    elif alignment == "median offset":
        ours = ours + float(np.median((truth - ours).numpy()))
    return float((ours - truth).abs().mean())
