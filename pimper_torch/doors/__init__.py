"""Input and output: photographs, cameras, meshes, result folders, metric scale."""
