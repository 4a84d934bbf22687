"""A surface of few faces with textures, for other programs to light."""
