"""From the sparse cloud to a surface of a few thousand facets."""
