"""Whether light determines the shape of a patch, and the cause if not."""

from collections import Counter
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.errors import caution
from pimper_torch.records import PatchStatus, Photometry

_DOUBT = (
    " If the light did move between the photographs, cameras or silhouettes are wrong: look at "
    "`overview.png`, and give masks or put a plain cloth behind the object."
)


def judge_data(
    shown: Bool[Tensor, " patch"],
    finite: Bool[Tensor, " patch"],
    seen: Bool[Tensor, "patch view sample"],
    lights: Float[Tensor, "patch view rank"],
    min_views: int,
    min_light_variation: float,
) -> Int[Tensor, " patch"]:
    """Tell which patches can be factorized.

    Args:
        shown: Whether a view has a sample there at all.
        finite: Whether one of them is finite.
        seen: Samples that are finite, and face the point light.
        lights: The field's.
        min_views: Views a sample must be lit in.
        min_light_variation: See :func:`light_varies`.

    Returns:
        A :class:`~pimper_torch.records.PatchStatus` each.
    """
    count = seen.sum(dim=2)
    fraction = count / count.amax(dim=1, keepdim=True).clamp_min(1)
    status = torch.zeros_like(count[:, 0])
    varies = light_varies(lights, fraction, min_light_variation)
    status[~varies] = int(PatchStatus.CONSTANT_LIGHT)
    status[~(seen.sum(dim=1) >= min_views).any(dim=1)] = int(PatchStatus.FEW_VIEWS)
    status[~finite] = int(PatchStatus.NOT_FINITE)
    status[~shown] = int(PatchStatus.UNSEEN)
    return status


def light_varies(
    lights: Float[Tensor, "patch view rank"],
    fraction: Float[Tensor, "patch view"],
    least: float,
) -> Bool[Tensor, " patch"]:
    r"""Tell in which patches the light changed enough between the views that see them.

    The lights, each scaled to length 1 so that exposure does not count, are weighed by the
    fraction of the patch that their view sees. A shading vector has three degrees of freedom:
    the third singular value of the weighted lights, over the first, must reach ``least``.
    """
    unit = (lights / lights.norm(dim=2, keepdim=True).clamp_min(1e-30)).double()
    moment = unit.mT @ (fraction.double()[..., None] * unit)
    values = torch.linalg.eigvalsh(moment).clamp_min(0)
    return (values[:, -3] > 0) & (values[:, -3] >= least**2 * values[:, -1])


def warn_of_undetermined(
    buckets: Sequence[Photometry], min_views: int, min_light_variation: float
) -> None:
    """Say once how many patches light could not determine, and why."""
    statuses = Counter(code for bucket in buckets for code in bucket.status.tolist())
    total = sum(statuses.values())
    undetermined = total - statuses[PatchStatus.DETERMINED]
    if undetermined == 0:
        return
    causes = {
        PatchStatus.UNSEEN: "{} have no valid sample in any view",
        PatchStatus.NOT_FINITE: "in {} all that views have is NaN or infinite",
        PatchStatus.FEW_VIEWS: f"{{}} are nowhere seen lit in {min_views} views",
        PatchStatus.CONSTANT_LIGHT: (
            "in {} the light varies too little between the views to tell shape from shading "
            f"(variation below {min_light_variation})"
        ),
        PatchStatus.FAILED: "in {} the solver found no finite answer",
    }
    parts = [text.format(statuses[code]) for code, text in causes.items() if statuses[code]]
    caution(
        f"Factorization: {undetermined} of {total} patches keep the normals of the coarse mesh: "
        f"{'; '.join(parts)}. There heights come from texture alone. "
        "Photograph these sides under more positions of the light, or lower "
        "`factorize.min_views` or `factorize.min_light_variation`."
        f"{_DOUBT if 2 * statuses[PatchStatus.CONSTANT_LIGHT] > total else ''}",
        stacklevel=4,
    )
