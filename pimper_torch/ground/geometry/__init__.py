"""Pure functions on tensors: frames, pinholes, pixels, surfaces, visibility."""
