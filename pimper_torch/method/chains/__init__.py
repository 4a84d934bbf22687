"""The two ways through the stages: coarse to fine, and as published."""
