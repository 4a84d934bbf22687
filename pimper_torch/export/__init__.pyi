# Public names, imported on first use (`__init__.py`).
__all__: list[str]
from .layouts import write_formats as write_formats
from .result import Result as Result
from .result import WrittenResult as WrittenResult
from .result import read_result as read_result
from .result import read_written as read_written
from .results import MeshFiles as MeshFiles
from .results import write_result as write_result
