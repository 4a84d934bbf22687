"""Baselines that reconstruct the same scenes."""

from pimper_bench.baselines.openmvs import OpenMvs
from pimper_bench.baselines.smoothed import Smoothed

__all__ = ["OpenMvs", "Smoothed"]
