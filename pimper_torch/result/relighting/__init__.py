"""The light of every photograph, and the materials, with the surface held fixed."""
