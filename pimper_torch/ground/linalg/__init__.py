"""Linear algebra the stages share: least squares on rasters and meshes, and its solvers."""
