"""Readers of camera files of other programs, converted to the conventions of this package."""
