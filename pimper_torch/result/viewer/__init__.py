"""A surface with its cameras and photographs, to turn and to light in a browser."""
