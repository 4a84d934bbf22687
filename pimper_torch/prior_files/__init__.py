"""Folders of maps that estimators write, as priors."""
