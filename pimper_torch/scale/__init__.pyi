# Public names, which are imported when they are asked for (`__init__.py`).
__all__: list[str]
from .find_scale import find_scale as find_scale
from .given import CameraDistance as CameraDistance
from .given import Mark as Mark
from .given import ScaleBar as ScaleBar
from .scale import Scale as Scale
from .scaled import scaled as scaled
