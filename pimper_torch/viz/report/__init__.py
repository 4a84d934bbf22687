"""The page of a run: one HTML file with its surface, photographs and stages."""
