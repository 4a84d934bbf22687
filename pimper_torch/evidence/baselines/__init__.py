"""Baselines, run on the same scene as the method."""

from pimper_torch.evidence.baselines.openmvs import OpenMvs, OpenMvsConfig
from pimper_torch.evidence.baselines.smoothed import Smoothed, SmoothedConfig

__all__ = ["OpenMvs", "OpenMvsConfig", "Smoothed", "SmoothedConfig"]
