"""Checks of photographs and of the machine, in seconds, before a run of minutes."""
