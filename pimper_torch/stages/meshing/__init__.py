"""Extraction, repair and simplification of meshes."""
