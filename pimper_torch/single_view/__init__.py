"""One viewpoint, many lights: photometric stereo, normal integration, response curves."""

from pimper_torch.single_view.integration import integrate_normal_map as integrate_normal_map
from pimper_torch.single_view.photometric_stereo import photometric_stereo as photometric_stereo
