# Public names, imported lazily (`__init__.py`).
__all__: list[str]
from .balm import solve_balm as solve_balm
from .bilinear import Bilinear as Bilinear
from .bilinear import Factors as Factors
from .bilinear import Solver as Solver
from .cone import Cone as Cone
from .factor_gradients import differentiable as differentiable
from .factorize import Factorize as Factorize
from .fit_light import FitLight as FitLight
from .fit_light import Illumination as Illumination
from .gauge import FixGauge as FixGauge
from .photometry_config import FactorizeConfig as FactorizeConfig
from .photometry_config import FitLightConfig as FitLightConfig
from .variable_projection import solve_variable_projection as solve_variable_projection
