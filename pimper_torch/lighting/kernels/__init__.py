"""Compiled functions of lighting models."""
