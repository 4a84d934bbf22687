"""Lights of the photographs and materials of the surface, with its shape held fixed."""
