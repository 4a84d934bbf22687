"""Folders and files of results: whole or not there, and nothing that is not ours removed."""
