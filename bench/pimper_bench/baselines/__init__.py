"""Baselines, run on the same scene as the method."""

from pimper_bench.baselines.openmvs import OpenMvs
from pimper_bench.baselines.smoothed import Smoothed

__all__ = ["OpenMvs", "Smoothed"]
