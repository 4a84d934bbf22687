"""Models of the light on a surface, and their fit to samples of photographs."""
