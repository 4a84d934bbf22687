"""Photometric stereo from one viewpoint, calibrated or uncalibrated, with one function."""

from pimper_torch.single_view.photometric_stereo.stereo import PhotometricStereo, photometric_stereo

__all__ = ["PhotometricStereo", "photometric_stereo"]
