"""Fusion of the patches on the subdivided coarse mesh."""
