"""The table: scenes, presets and rivals, measured alike."""
