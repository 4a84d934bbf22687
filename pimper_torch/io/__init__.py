"""Reading of photographs and meshes, and writing of results."""
