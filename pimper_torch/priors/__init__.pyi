# Public names, which are imported when they are asked for (`__init__.py`).
__all__: list[str]
from .network import priors_of as priors_of
from .settled import settled as settled
