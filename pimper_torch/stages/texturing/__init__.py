"""Meshes of few faces with textures, for rendering in other programs."""
