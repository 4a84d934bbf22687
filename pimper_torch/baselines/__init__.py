"""Rivals, to be run beside the method on the same scene."""

from pimper_torch.baselines.global_stereo import GlobalStereo, GlobalStereoConfig
from pimper_torch.baselines.lim import Lim, LimConfig
from pimper_torch.baselines.smoothed import Smoothed, SmoothedConfig

__all__ = [
    "GlobalStereo",
    "GlobalStereoConfig",
    "Lim",
    "LimConfig",
    "Smoothed",
    "SmoothedConfig",
]
