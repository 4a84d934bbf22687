"""Settings and chains by the name of a preset."""
