"""The table: scenes, presets and baselines under one evaluation."""
