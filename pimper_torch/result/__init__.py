"""Products of a surface: lights and materials, textures, images and pages."""
