"""Stages of the published chain: facets are reconstructed separately, then joined."""
