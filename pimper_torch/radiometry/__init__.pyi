# Public names, which are imported when they are asked for (`__init__.py`).
__all__: list[str]
from .encoding import FROM_FILES as FROM_FILES
from .encoding import LINEAR as LINEAR
from .encoding import SATURATED as SATURATED
from .encoding import SRGB as SRGB
from .encoding import Encoding as Encoding
from .response import Curve as Curve
from .response import Gamma as Gamma
from .response import Linear as Linear
from .response import Response as Response
from .response import Srgb as Srgb
from .response import linear_from_srgb as linear_from_srgb
from .response import srgb_from_linear as srgb_from_linear
from .response import to_bytes as to_bytes
from .saturation import find_saturation as find_saturation
