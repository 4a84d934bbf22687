"""What patches say of the surface, brought together on the lattice of the coarse mesh."""
