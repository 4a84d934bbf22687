"""Geometry, linear algebra, radiometry and compiled kernels: nothing of the method."""
