"""What is made of a surface: lights and materials, textures, pictures and pages."""
