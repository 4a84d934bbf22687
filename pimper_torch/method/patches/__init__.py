"""Facets to templates, and views resampled on them."""
