"""Figures that compare a result with the truth, each under its own named convention."""

from pimper_torch.metrics.relative import ViewComparison, compare_in_view, relative_error
from pimper_torch.metrics.similarity import (
    pair_views,
    similarity_between_cameras,
    similarity_between_points,
)

__all__ = [
    "ViewComparison",
    "compare_in_view",
    "pair_views",
    "relative_error",
    "similarity_between_cameras",
    "similarity_between_points",
]
