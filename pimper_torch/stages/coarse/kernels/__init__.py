"""Compiled functions of this step."""
