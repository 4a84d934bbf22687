"""Folders of maps that networks wrote, as priors."""

from pimper_torch.priors.prior_files.read_maps import read_depth as read_depth
from pimper_torch.priors.prior_files.read_maps import read_normals as read_normals
from pimper_torch.priors.prior_files.read_silhouettes import object_at as object_at
from pimper_torch.priors.prior_files.read_silhouettes import read_silhouettes as read_silhouettes
