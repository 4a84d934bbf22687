"""Stages of the published chain alone: every facet by itself, then all joined."""
