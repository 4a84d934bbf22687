"""The table: scenes, presets and baselines, measured in the same way."""
