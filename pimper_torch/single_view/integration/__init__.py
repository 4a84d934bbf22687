"""Integration of normal maps."""

from pimper_torch.single_view.integration.discontinuities import ContinuousSteps
from pimper_torch.single_view.integration.normal_map import IntegratedMap, integrate_normal_map

__all__ = ["ContinuousSteps", "IntegratedMap", "integrate_normal_map"]
