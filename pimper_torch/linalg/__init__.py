"""Linear algebra the stages share: sparse systems, and Poisson's equation on rasters."""
