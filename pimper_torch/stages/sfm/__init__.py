"""Photographs to cameras and a sparse cloud."""
