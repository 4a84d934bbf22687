"""Cameras as other programs write them, and the conventions that they mix up."""
