"""Normals of every patch to its relief."""
