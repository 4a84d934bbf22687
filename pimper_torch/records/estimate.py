"""A method's estimate of an object."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from pimper_torch.records.record import Record
from pimper_torch.records.scene import Mesh
from pimper_torch.records.views import Cameras


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Estimate(Record):
    """A method's estimate of an object, in a frame of its own.

    Attributes:
        mesh: The surface; may have no faces if the method gives points only.
        names: Of the views it found cameras for, as the photographs are called.
        cameras: One a name, in the same order; ``None`` if the method gives none.
        lights_world: First-order light of each view, up to one scale; ``None`` if unknown.
        reference: Name of the view the surface was made in, if there is one.
    """

    mesh: Mesh
    names: tuple[str, ...] = ()
    cameras: Cameras | None = None
    lights_world: Float[Tensor, "view 4"] | None = None
    reference: str | None = None
