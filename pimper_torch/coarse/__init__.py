"""The sparse cloud to a few hundred facets."""
