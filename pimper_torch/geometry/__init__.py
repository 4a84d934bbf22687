"""Geometry: frames, cameras, pixels, silhouettes, surfaces, visibility."""
