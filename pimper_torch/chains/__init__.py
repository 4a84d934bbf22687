"""The two chains of stages: coarse to fine, and as published."""
