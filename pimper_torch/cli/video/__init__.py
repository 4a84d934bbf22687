"""Photographs from a video: sharp frames, evenly spaced by the motion of the picture."""
