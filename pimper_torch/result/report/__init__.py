"""The page of a run: one file that shows its surface, photographs and stages in a browser."""
