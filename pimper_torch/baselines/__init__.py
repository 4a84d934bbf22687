"""Rival methods, so that every claim has its rival in the same run."""
