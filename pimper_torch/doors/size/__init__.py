"""The real size of a result: from lengths that are known, and markers that were printed."""

from pimper_torch.doors.size.find_scale import find_scale as find_scale
from pimper_torch.doors.size.given import CameraDistance as CameraDistance
from pimper_torch.doors.size.given import Mark as Mark
from pimper_torch.doors.size.given import ScaleBar as ScaleBar
from pimper_torch.doors.size.scale import Scale as Scale
from pimper_torch.doors.size.scaled import scaled as scaled
