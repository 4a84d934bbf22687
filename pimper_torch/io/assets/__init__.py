"""Files of textured meshes: glTF, USD, and their placement in the world."""
