# Public names, which are imported when they are asked for (`__init__.py`).
__all__: list[str]
from .integration import integrate_normal_map as integrate_normal_map
from .photometric_stereo import photometric_stereo as photometric_stereo
