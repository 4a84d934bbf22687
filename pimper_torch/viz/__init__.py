"""Figures of a result."""

from pimper_torch.viz.patch_figures import by_facet as by_facet
from pimper_torch.viz.patch_figures import plot_in_view as plot_in_view
from pimper_torch.viz.patch_figures import plot_patch as plot_patch
