"""Verdict on a result, from the figures of its run."""
