"""Dense surfaces from photographs of many viewpoints and unknown lights."""
