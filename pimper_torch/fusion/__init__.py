"""What patches say of the surface, brought together on the subdivided mesh of the coarse mesh."""
