"""Templates on facets, and views resampled on them."""
