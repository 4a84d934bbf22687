"""Conventions that data leave open: candidates, their scores, and when one is believed."""
