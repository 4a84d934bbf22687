"""Reliefs of all patches, put in one frame."""
