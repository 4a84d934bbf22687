"""Baselines, run on the same scene as the method."""

from pimper_torch.evidence.baselines.openmvs import OpenMvs
from pimper_torch.evidence.baselines.smoothed import Smoothed

__all__ = ["OpenMvs", "Smoothed"]
