"""A surface with its cameras and photographs, to turn in a browser."""
