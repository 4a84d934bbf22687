"""Whether light told the shape of a patch, and what kept it from that."""

from collections import Counter
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.errors import caution
from pimper_torch.photometry.certainty import light_varies
from pimper_torch.records import PatchVerdict, Photometry


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
        seen: Samples that are finite, and face the lamp.
        lights: The field's.
        min_views: Views a sample must be lit in.
        min_light_variation: See :func:`~pimper_torch.photometry.certainty.light_varies`.

    Returns:
        A :class:`~pimper_torch.records.PatchVerdict` each.
    """
    count = seen.sum(dim=2)
    share = count / count.amax(dim=1, keepdim=True).clamp_min(1)
    verdict = torch.zeros_like(count[:, 0])
    varies = light_varies(lights, share, min_light_variation)
    verdict[~varies] = int(PatchVerdict.CONSTANT_LIGHT)
    verdict[~(seen.sum(dim=1) >= min_views).any(dim=1)] = int(PatchVerdict.FEW_VIEWS)
    verdict[~finite] = int(PatchVerdict.NOT_FINITE)
    verdict[~shown] = int(PatchVerdict.UNSEEN)
    return verdict


def warn_of_verdicts(
    buckets: Sequence[Photometry], min_views: int, min_light_variation: float
) -> None:
    """Say once how many patches light could not determine, and why."""
    verdicts = Counter(code for bucket in buckets for code in bucket.verdict.tolist())
    total = sum(verdicts.values())
    undetermined = total - verdicts[PatchVerdict.DETERMINED]
    if undetermined == 0:
        return
    causes = {
        PatchVerdict.UNSEEN: "{} have no valid sample in any view",
        PatchVerdict.NOT_FINITE: "in {} all that views have is NaN or infinite",
        PatchVerdict.FEW_VIEWS: f"{{}} are nowhere seen lit in {min_views} views",
        PatchVerdict.CONSTANT_LIGHT: (
            "in {} the light varies too little between the views to tell shape from shading "
            f"(variation below {min_light_variation})"
        ),
        PatchVerdict.FAILED: "in {} the solver found no finite answer",
    }
    parts = [text.format(verdicts[code]) for code, text in causes.items() if verdicts[code]]
    caution(
        f"Factorization: {undetermined} of {total} patches keep the normals of the coarse mesh: "
        f"{'; '.join(parts)}. Their geometry is delivered without photometric detail. "
        "Photograph these sides under more positions of the light, or lower "
        "`factorize.min_views` or `factorize.min_light_variation`.",
        stacklevel=4,
    )
