"""Integration of normal maps."""

from pimper_torch.single_view.integration.discontinuities import Continuity, DiscontinuityConfig
from pimper_torch.single_view.integration.normal_map import IntegratedMap, integrate_normal_map

__all__ = ["Continuity", "DiscontinuityConfig", "IntegratedMap", "integrate_normal_map"]
