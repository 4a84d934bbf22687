"""Files: photographs in, results out."""
