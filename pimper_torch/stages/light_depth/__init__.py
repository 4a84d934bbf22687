"""Depths by a sweep under the fitted light, where photographs contradict the coarse surface."""
