"""Photometric stereo from one viewpoint: lights known or not, and one call for all methods."""

from pimper_torch.single_view.photometric_stereo.stereo import PhotometricStereo, photometric_stereo

__all__ = ["PhotometricStereo", "photometric_stereo"]
