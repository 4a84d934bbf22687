"""Evaluation of the chain: scenes of known truth, data sets, metrics, baselines, tables."""
