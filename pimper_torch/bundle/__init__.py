"""Cameras, adjusted afterwards to what the photographs show on the surface."""
