"""The method, step by step, and the chains of its stages."""
