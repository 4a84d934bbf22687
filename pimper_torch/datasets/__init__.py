"""Readers of public data sets, and their layouts as formats to write."""
