"""Which part of a split model to go on with."""

from collections.abc import Sequence

from pimper_torch.errors import ReconstructionError
from pimper_torch.sfm.model import list_some

ADVICE = (
    "Neighbouring photographs should overlap by two thirds and differ by less than about 20 "
    "degrees in viewpoint: add photographs between those that did not register, or give an "
    "existing COLMAP model. Lowering `reconstruct.peak_threshold` finds fainter features."
)


def choose_component(
    components: Sequence[tuple[str, ...]], names: Sequence[str], min_share: float
) -> int:
    """Choose the component to keep: the one with most views, if it is a clear majority.

    Args:
        components: Names of the views in each component; they may overlap.
        names: Of all photographs.
        min_share: Of the photographs that the chosen component must have when another one
            holds at least 3 views that it lacks.

    Returns:
        Index of the component; the first of equals.

    Raises:
        ReconstructionError: Fewer than 3 views registered, or there is no clear majority.
    """
    largest = max(range(len(components)), key=lambda index: len(components[index]), default=-1)
    kept = components[largest] if components else ()
    if len(kept) < 3:
        missing = [name for name in names if name not in kept]
        raise ReconstructionError(
            f"Structure from motion registered {len(kept)} of {len(names)} photographs; at least "
            f"3 are needed. Not registered: {list_some(missing, most=20)}. {ADVICE}"
        )
    rivals = [part for part in components if len(set(part) - set(kept)) >= 3]
    if rivals and len(kept) < min_share * len(names):
        parts = "; ".join(
            f"{len(part)} photographs ({list_some(part, most=12)})" for part in (kept, *rivals)
        )
        raise ReconstructionError(
            f"Structure from motion split {len(names)} photographs into {1 + len(rivals)} models "
            f"that nothing ties together: {parts}. One model with at least {min_share:.0%} of the "
            f"photographs is needed. {ADVICE} Or reconstruct one of the groups on its own."
        )
    return largest
