"""Photographs out of a video: frames that are sharp, and as far apart as the camera moved."""
