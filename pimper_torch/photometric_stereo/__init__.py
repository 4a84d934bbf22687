"""Photometric stereo from one viewpoint."""
