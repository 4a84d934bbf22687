"""Geometry, linear algebra, radiometry and compiled kernels, independent of the method."""
