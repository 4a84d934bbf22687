"""The status of patches: whether light determines their normals, and the cause if not."""

from collections import Counter
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.records import PatchStatus, Photometry
from pimper_torch.runtime.errors import caution

# Fractions of plain sets are up to 0.48: jar 0.48, balls 0.43 and potatoes 0.40 (12 views along the
# arc, 320x240, fast), the demo 0.28. Half of these facets are at the back, where no view sees them.
_MAX_UNDETERMINED = 0.6
_IF_LIGHT_MOVED = (
    " If the light did move between photographs, cameras or silhouettes are wrong: check "
    "`overview.png`, and provide masks or put a plain cloth behind the object."
)


def photometric_status(
    observed: Bool[Tensor, " patch"],
    finite: Bool[Tensor, " patch"],
    seen: Bool[Tensor, "patch view sample"],
    lights: Float[Tensor, "patch view rank"],
    min_views: int,
    min_light_variation: float,
) -> Int[Tensor, " patch"]:
    """Return each patch's :class:`~pimper_torch.records.PatchStatus` before it is factorized.

    Args:
        observed: Whether any view has a valid sample.
        finite: Whether any valid sample is finite.
        seen: Samples that are finite and lit.
        lights: First-order light in each view, from the light field.
        min_views: Number of views a sample must be lit in.
        min_light_variation: See :func:`light_varies`.
    """
    count = seen.sum(dim=2)
    status = torch.zeros_like(count[:, 0])
    varies = light_varies(lights, count, min_light_variation)
    status[~varies] = int(PatchStatus.CONSTANT_LIGHT)
    status[~(seen.sum(dim=1) >= min_views).any(dim=1)] = int(PatchStatus.FEW_VIEWS)
    status[~finite] = int(PatchStatus.NOT_FINITE)
    status[~observed] = int(PatchStatus.UNSEEN)
    return status


def light_varies(
    lights: Float[Tensor, "patch view rank"],
    weight: Float[Tensor, "patch view"] | Int[Tensor, "patch view"],
    min_ratio: float,
) -> Bool[Tensor, " patch"]:
    """Return the patches in which the light varies enough between views.

    A shading vector has three degrees of freedom: the third singular value of the matrix of
    lights, over the first, must be at least ``min_ratio``. Lights are normalized, so exposure does
    not matter, and weighted, such as by the samples that their view sees; a common factor cancels.
    """
    unit = (lights / lights.norm(dim=2, keepdim=True).clamp_min(1e-30)).double()
    moment = unit.mT @ (weight.double()[..., None] * unit)
    values = torch.linalg.eigvalsh(moment).clamp_min(0)
    return (values[:, -3] > 0) & (values[:, -3] >= min_ratio**2 * values[:, -1])


def warn_of_undetermined(
    buckets: Sequence[Photometry], min_views: int, min_light_variation: float
) -> None:
    """Warn, with counts by cause, if light does not determine the normals of most patches."""
    statuses = Counter(code for bucket in buckets for code in bucket.status.tolist())
    total = sum(statuses.values())
    # Failed patches are reported by runtime.failures.
    undetermined = total - statuses[PatchStatus.DETERMINED] - statuses[PatchStatus.FAILED]
    if undetermined <= _MAX_UNDETERMINED * total:
        return
    causes = {
        PatchStatus.UNSEEN: "{} have no valid sample in any view",
        PatchStatus.NOT_FINITE: "in {} all radiance is NaN or infinite",
        PatchStatus.FEW_VIEWS: f"{{}} have no sample lit in {min_views} views",
        PatchStatus.CONSTANT_LIGHT: (
            "in {} the light varies too little between the views to determine normals "
            f"(variation below {min_light_variation})"
        ),
    }
    counts = [text.format(statuses[code]) for code, text in causes.items() if statuses[code]]
    caution(
        f"Factorization: {undetermined} of {total} patches keep the normals of the coarse mesh: "
        f"{'; '.join(counts)}. Their shape comes from the coarse mesh and swept heights only. "
        "Photograph these sides under more positions of the light, or lower "
        "`factorize.min_views` or `factorize.min_light_variation`."
        f"{_IF_LIGHT_MOVED if 2 * statuses[PatchStatus.CONSTANT_LIGHT] > total else ''}",
        stacklevel=4,
    )
