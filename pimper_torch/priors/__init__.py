"""Conventions of guessed maps, found by the scene, and guesses of networks."""
