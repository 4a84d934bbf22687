"""Interactive display of a surface with its cameras and photographs in a browser."""
