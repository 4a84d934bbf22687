"""Settings: YAML to nested frozen dataclasses, strictly.

A setting is a field of a config dataclass in the room of its stage, in a module that imports no
torch, such as ``sweep_config``; its default is the method's.
A YAML file holds only what differs. Unknown keys and wrong types are refused when the file
is read, impossible values when the dataclass is made (:func:`require_ranges`, :func:`require`).
"""

import dataclasses
import difflib
import math
import re
import types
import typing
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import Literal, TypeVar, Union

import yaml

from pimper_torch.runtime.errors import ConfigError, shortened

Config = TypeVar("Config")

_UNITS = {"MB": 10**6, "GB": 10**9}
# What values are called in messages, by their type.
_WORDS: dict[object, str] = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    Path: "a path",
    types.NoneType: "null",
}


def require(ok: bool, field: str, value: object, needed: str) -> None:
    """Refuse an impossible setting."""
    if not ok:
        raise ConfigError(f"{field} is {value!r}; needed: {needed}.")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Range:
    """Numbers that a field takes: ``steps: Annotated[int, Range(least=1, most=1000)] = 4``.

    Attributes:
        least: The smallest value; or
        above: a number that every value exceeds.
        below: A number that exceeds every value.
        most: The largest value. Beyond it memory or time does not suffice, iterations have
            converged, photographs or processors are not that many, or a product with zero
            is undefined.
    """

    least: int | float | None = None
    above: int | float | None = None
    below: int | float | None = None
    most: int | float = math.inf

    def needed(self, value: int | float) -> str:
        """Return the bound that a value exceeds, in words; nothing where it is inside."""
        low = self.above if self.least is None else self.least
        assert low is not None, "a range has a lower bound"
        enough = value > low if self.least is None else value >= low
        if self.below is not None:
            bracket = "(" if self.least is None else "["
            inside = enough and value < self.below
            return "" if inside else f"in {bracket}{low:g}, {self.below:g})"
        if not enough:
            return f"above {low:g}" if self.least is None else f"{low:g} or more"
        return "" if value <= self.most else f"{self.most:,.12g} at most"


def require_ranges(config: object, section: str = "") -> None:
    """Refuse values outside the :class:`Range` that annotates their field.

    Args:
        config: Whose fields they are; ``None`` is in every range.
    """
    for name, hint in typing.get_type_hints(type(config), include_extras=True).items():
        for mark in getattr(hint, "__metadata__", ()):
            value = getattr(config, name)
            if isinstance(mark, Range) and value is not None:
                needed = mark.needed(value)
                require(not needed, _join(section, name), value, needed)


def bytes_of(size: str, field: str = "max_memory") -> float:
    """Read a size such as ``4GB`` or ``800 MB``; infinite where nothing is said.

    >>> bytes_of("1.5 GB")
    1500000000.0
    """
    if not size:
        return math.inf
    found = re.fullmatch(r"\s*(\d+\.?\d*)\s*([MG]B)\s*", size, re.IGNORECASE)
    require(found is not None, field, size, "a size such as 4GB or 800MB")
    assert found is not None
    return float(found[1]) * _UNITS[found[2].upper()]


def build(cls: type[Config], mapping: Mapping[str, object], where: str) -> Config:
    """Make a config dataclass, nested ones included, from a mapping such as YAML gives.

    Fields that the mapping leaves out keep their defaults. An int serves as a float; no
    other type stands in for another, and a bool is no number. Understood annotations are
    bool, int, float, str, ``Path``, ``Literal``, tuples (from lists), unions of these, and
    dataclasses of all. Inverse of :func:`to_mapping`.

    Args:
        where: What the mapping is, for messages; a file's name for instance.

    Raises:
        ConfigError: For an unknown key (names the nearest and all valid ones), a wrong
            type, or a value that the dataclass itself refuses.
    """
    return _build(cls, mapping, where, "", cls)


def to_mapping(config: object) -> dict[str, object]:
    """Turn a config into plain mappings, lists, numbers and strings, ready for YAML.

    Class variables come first: they tell configs of several kinds apart.
    """
    assert dataclasses.is_dataclass(config), f"{config!r} is no dataclass"
    names = (*_kind_names(type(config)), *(field.name for field in dataclasses.fields(config)))
    return {name: _plain(getattr(config, name)) for name in names}


def to_yaml(config: object) -> str:
    """Write every setting of a config, defaults included, as YAML."""
    return yaml.safe_dump(to_mapping(config), sort_keys=False, allow_unicode=True)


def written(value: object) -> str:
    """Write one plain value as YAML, in a line.

    >>> written([0.5, 1.0]), written("on")
    ('[0.5, 1.0]', "'on'")
    """
    text = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=math.inf)
    return text.removesuffix("...\n").strip()


def overlay(base: Mapping[str, object], other: Mapping[str, object]) -> dict[str, object]:
    """Lay the settings of ``other`` over those of ``base``, section by section.

    >>> overlay({"sweep": {"steps": 9, "window": 5}}, {"sweep": {"steps": 15}})
    {'sweep': {'steps': 15, 'window': 5}}
    """
    merged = dict(base)
    for key, value in other.items():
        below = merged.get(key)
        if isinstance(below, Mapping) and isinstance(value, Mapping | None):
            merged[key] = overlay(below, value or {})  # an empty section changes nothing
        else:
            merged[key] = value
    return merged


def find_config(name_or_path: str | Path) -> Path:
    """Find the YAML file of a preset such as ``"paper"``, or check that a file is there.

    A text with a suffix or a folder in it is a path; any other names a preset.

    Raises:
        ConfigError: No such preset (names the nearest), or no such file.
    """
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml") or len(path.parts) > 1 or isinstance(name_or_path, Path):
        if not path.is_file():
            raise ConfigError(
                f"{path}: there is no such file; needed: a YAML file of settings, or one of the "
                f"presets {', '.join(presets())}."
            )
        return path
    if name_or_path not in presets():
        raise ConfigError(
            f"there is no preset {name_or_path!r}.{nearest(name_or_path, presets())} "
            f"Presets: {', '.join(presets())}; or give the path of a YAML file."
        )
    return _preset_folder() / f"{name_or_path}.yaml"


def presets() -> tuple[str, ...]:
    """Name the settings that come with the package."""
    return tuple(sorted(path.stem for path in _preset_folder().glob("*.yaml")))


def read_mapping(path: Path | str) -> dict[str, object]:
    """Read a YAML file of settings.

    Raises:
        ConfigError: The file cannot be read, is no YAML, gives a key twice, or holds
            something other than ``key: value`` settings.
    """
    path = Path(path)
    try:
        if path.stat().st_size > 1_000_000:  # all settings with comments take 20 kB
            raise ConfigError(
                f"{path}: has {path.stat().st_size} bytes; needed: a file of settings."
            )
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_OnceLoader)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}. Needed: a YAML text file.") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: is no valid YAML: {error}") from error
    except RecursionError as error:
        raise ConfigError(f"{path}: is nested too deeply; needed: settings in sections.") from error
    except (ValueError, TypeError, OverflowError, AttributeError) as error:
        # PyYAML's constructors of numbers and dates raise these.
        raise ConfigError(
            f"{path}: holds a value that is none ({shortened(str(error))}); needed: numbers, "
            "texts, lists and sections."
        ) from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(
            f"{path}: holds {_kind(content)}; needed: settings as `key: value`, in sections."
        )
    return content


class _OnceLoader(yaml.SafeLoader):
    """Safe YAML that refuses a key given twice, of which the first would silently be lost.

    Aliases are refused, too: nine lines of them can stand for more values than memory holds.
    """

    def compose_node(  # stubs know of numbers alone, and an index may be a node, or nothing
        self,
        parent: yaml.Node | None,
        index: typing.Any,  # noqa: ANN401
    ) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.composer.ComposerError(
                problem="aliases (`*name`) are not read; write the value out",
                problem_mark=self.peek_event().start_mark,  # type: ignore[no-untyped-call]
            )
        return super().compose_node(parent, index)

    def construct_mapping(
        self, node: yaml.MappingNode, deep: bool = False
    ) -> dict[Hashable, object]:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(
                    problem="a key is a list or a section; needed: a name",
                    problem_mark=key.start_mark,
                )
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    problem=f"the key `{key.value}` is given twice", problem_mark=key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _preset_folder() -> Path:
    package = Path(str(resources.files("pimper_torch")))
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def _build(
    cls: type[Config], mapping: object, where: str, section: str, root: type[object]
) -> Config:
    if not isinstance(mapping, Mapping):
        raise ConfigError(
            f"{where}: {section or 'the whole'} is {_shown(mapping)}; "
            f"needed: a section with some of {', '.join(_names(cls))}."
        )
    hints, kinds = typing.get_type_hints(cls), _kind_names(cls)
    values: dict[str, typing.Any] = {}
    for key, value in mapping.items():
        if key in kinds:
            require(value == getattr(cls, key), f"{where}: {key}", value, repr(getattr(cls, key)))
            continue
        if key not in _names(cls):
            homes = [path for path in _paths(root, "") if path.rpartition(".")[2] == key]
            elsewhere = f" Did you mean `{'` or `'.join(homes)}`?"
            near = elsewhere if homes else nearest(shortened(str(key)), _names(cls))
            place = f"section `{section}`" if section else "the top level"
            raise ConfigError(
                f"{where}: {place} has no setting `{shortened(str(key))}`.{near} Settings there: "
                f"{', '.join(_names(cls))}."
            )
        hint, field = hints[key], _join(section, key)
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            values[key] = _build(hint, {} if value is None else value, where, field, root)
        else:
            values[key] = _convert(hint, value, f"{where}: {field}")
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {section + ': ' if section else ''}{error}") from error


def _convert(hint: object, value: object, field: str) -> object:
    """Turn a YAML value into what the annotation of its field asks for, or refuse it."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        for choice in args:
            with suppress(ConfigError):
                return _convert(choice, value, field)
    elif origin is tuple and isinstance(value, list | tuple):
        if len(args) == 2 and args[1] is Ellipsis:
            args = args[:1] * len(value)
        if len(args) == len(value):
            return tuple(
                _convert(arg, item, f"{field}[{place}]")
                for place, (arg, item) in enumerate(zip(args, value, strict=True))
            )
    elif origin is Literal:
        if any(choice == value and type(choice) is type(value) for choice in args):
            return value
    elif hint is float:
        exponent = isinstance(value, str) and "e" in value.lower()
        # YAML 1.1 takes 1e-3, without a dot, for a text; a whole number may have 310 digits.
        with suppress(ValueError, OverflowError):
            if type(value) in (int, float) or exponent:
                return float(value)  # type: ignore[arg-type]
    elif hint is Path and isinstance(value, str | Path):
        return Path(value)
    elif type(value) is hint:
        return value
    raise ConfigError(f"{field} is {_shown(value)}; needed: {_needed(hint)}.")


def _shown(value: object) -> str:
    return f"{shortened(repr(value))} ({_kind(value)})"


def nearest(key: str, valid: Sequence[str]) -> str:
    """Ask whether another name was meant, in a sentence; nothing where none is near."""
    near = difflib.get_close_matches(key, valid, n=1, cutoff=0.5)
    return f" Did you mean `{near[0]}`?" if near else ""


def _names(cls: type[object]) -> tuple[str, ...]:
    assert dataclasses.is_dataclass(cls), f"{cls!r} is no dataclass"
    return tuple(field.name for field in dataclasses.fields(cls) if field.init)


def _kind_names(cls: type[object]) -> tuple[str, ...]:
    """Name the class variables of a config, which say of what kind it is."""
    hints = typing.get_type_hints(cls)
    return tuple(name for name in hints if typing.get_origin(hints[name]) is typing.ClassVar)


def _paths(cls: type[object], section: str) -> Iterator[str]:
    """List every setting of a config and of those inside it."""
    for name, hint in typing.get_type_hints(cls).items():
        yield _join(section, name)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            yield from _paths(hint, _join(section, name))


def _join(section: str, name: str) -> str:
    return f"{section}.{name}" if section else name


def _plain(value: object) -> object:
    if dataclasses.is_dataclass(value):
        return to_mapping(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _needed(hint: object) -> str:
    """Describe an annotation in the words of somebody who writes YAML."""
    args = typing.get_args(hint)
    if typing.get_origin(hint) is Literal:
        return "one of " + ", ".join(repr(choice) for choice in args)
    if typing.get_origin(hint) in (Union, types.UnionType):
        return " or ".join(_needed(arg) for arg in args)
    if typing.get_origin(hint) is tuple:
        if len(args) == 2 and args[1] is Ellipsis:
            return f"a list, each entry {_needed(args[0])}"
        return "a list of " + ", ".join(_needed(arg) for arg in args)
    return _WORDS[hint]


def _kind(value: object) -> str:
    if value is None:
        return "nothing"
    return _WORDS.get(type(value), "a list" if isinstance(value, list | tuple) else "a section")
