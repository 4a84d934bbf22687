"""Places in photographs, and known lengths, on a command line: as often as there are some."""

from typing import Annotated, Any, Literal

import tyro

from pimper_torch.errors import ConfigError
from pimper_torch.size.given import CameraDistance, Mark, ScaleBar


def _number(word: str, option: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ConfigError(f"{option}: the length is {word!r}; needed: a number.") from None


def _bar(words: list[str]) -> ScaleBar:
    first, second, length = words
    return ScaleBar(
        first=Mark.read(first), second=Mark.read(second), length=_number(length, "--scale-bar")
    )


def _distance(words: list[str]) -> CameraDistance:
    first, second, length = words
    return CameraDistance(first=first, second=second, length=_number(length, "--camera-distance"))


_Place = Annotated[
    Mark,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="NAME,x,y",
        instance_from_str=lambda words: Mark.read(words[0]),
        is_instance=lambda one: isinstance(one, Mark),
        str_from_instance=lambda one: [str(one)],
    ),
]
Places = Annotated[tyro.conf.UseAppendAction[tuple[_Place, ...]], tyro.conf.arg(metavar="NAME,x,y")]


def _three_words(read: Any, kind: type) -> Any:  # noqa: ANN401 - of tyro's marks
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=3,
        metavar="A B LENGTH",
        instance_from_str=read,
        is_instance=lambda one: isinstance(one, kind),
        str_from_instance=lambda one: [str(one.first), str(one.second), str(one.length)],
    )


_Bar = Annotated[ScaleBar, _three_words(_bar, ScaleBar)]
_Distance = Annotated[CameraDistance, _three_words(_distance, CameraDistance)]

ScaleBars = Annotated[
    tyro.conf.UseAppendAction[tuple[_Bar, ...]],
    tyro.conf.arg(metavar="A,x,y B,x,y LENGTH"),
]
CameraDistances = Annotated[
    tyro.conf.UseAppendAction[tuple[_Distance, ...]],
    tyro.conf.arg(metavar="A B LENGTH"),
]
Markers = Annotated[Literal["auto", "off"] | float, tyro.conf.arg(metavar="auto|off|MM")]
