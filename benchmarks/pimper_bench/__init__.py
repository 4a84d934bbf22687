"""Evaluation: scenes with ground truth, data sets, metrics, baselines, tables."""
