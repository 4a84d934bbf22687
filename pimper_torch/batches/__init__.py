"""Many objects: whole reconstructions over any ``concurrent.futures.Executor``."""
