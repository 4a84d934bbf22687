# Public names, which are imported when they are asked for (`__init__.py`).
__all__: list[str]
from .conventions import resolve_prior_conventions as resolve_prior_conventions
from .network import from_onnx as from_onnx
from .network import priors_of as priors_of
from .segmenter import segment as segment
