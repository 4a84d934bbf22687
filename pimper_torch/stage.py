"""What every stage is: a module that takes records and gives one."""

from typing import TYPE_CHECKING, Generic, ParamSpec, Protocol, TypeVar

from torch import nn

P = ParamSpec("P")
R = TypeVar("R", covariant=True)
T = TypeVar("T")


class _Forward(Protocol[P, R]):
    def forward(self, *args: P.args, **kwargs: P.kwargs) -> R: ...


class Stage(nn.Module):
    """A module whose call has the types of its ``forward``, for a checker of types.

    ``nn.Module`` alone may be called with anything and gives anything. A stage of one's own that
    derives from this class is checked where it is put into a chain and wherever it is called.
    """

    if TYPE_CHECKING:

        def __call__(self: _Forward[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
            """Run the stage."""


class Given(Stage, Generic[T]):
    """A stage that gives what it was made with, whatever it is handed: a record that is at hand."""

    def __init__(self, record: T) -> None:
        super().__init__()
        self.record = record

    def forward(self, *_: object) -> T:
        """Give it."""
        return self.record
