"""What comes in and goes out: photographs, cameras, meshes, folders of results, real size."""
