"""Outlines as constraints on the surface: it is tangent to the rays through them."""
