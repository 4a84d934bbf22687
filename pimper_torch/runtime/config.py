"""Settings: nested frozen dataclasses from YAML, with strict checks.

A setting is a field of a config dataclass in the subpackage of its stage, in a module that does not
import torch, such as ``sweep_config``; its default is the method's. A YAML file contains only the
settings that differ. Unknown keys and wrong types are refused when the file is read, impossible
values when the dataclass is constructed (:func:`require_ranges`, :func:`require`).
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
# Names of types in messages.
_WORDS: dict[object, str] = {
    bool: "true or false",
    int: "an integer",
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
    """Valid numbers of a field: ``steps: Annotated[int, Range(least=1, most=1000)] = 4``.

    Attributes:
        least: The smallest valid value; or
        above: an exclusive lower bound.
        below: An exclusive upper bound.
        most: The largest valid value; above it memory or time does not suffice, iterations have
            converged, photographs or processors are fewer, or a product with zero is undefined.
    """

    least: int | float | None = None
    above: int | float | None = None
    below: int | float | None = None
    most: int | float = math.inf

    def needed(self, value: int | float) -> str:
        """Return the violated bound in words; an empty text if the value is valid."""
        low = self.above if self.least is None else self.least
        assert low is not None, "a range has a lower bound"
        enough = value > low if self.least is None else value >= low
        if self.below is not None:
            bracket = "(" if self.least is None else "["
            inside = enough and value < self.below
            return "" if inside else f"in {bracket}{low:g}, {self.below:g})"
        if not enough:
            return f"above {low:g}" if self.least is None else f"{low:g} or more"
        return "" if value <= self.most else f"at most {self.most:,.12g}"


def require_ranges(config: object, section: str = "") -> None:
    """Refuse field values outside their annotated :class:`Range`; ``None`` is always valid."""
    for name, hint in typing.get_type_hints(type(config), include_extras=True).items():
        for mark in getattr(hint, "__metadata__", ()):
            value = getattr(config, name)
            if isinstance(mark, Range) and value is not None:
                needed = mark.needed(value)
                require(not needed, _join(section, name), value, needed)


def bytes_of(size: str, field: str = "max_memory") -> float:
    """Return the bytes of a size such as ``4GB`` or ``800 MB``; infinite for an empty text.

    >>> bytes_of("1.5 GB")
    1500000000.0
    """
    if not size:
        return math.inf
    match = re.fullmatch(r"\s*(\d+\.?\d*)\s*([MG]B)\s*", size, re.IGNORECASE)
    require(match is not None, field, size, "a size such as 4GB or 800MB")
    assert match is not None
    return float(match[1]) * _UNITS[match[2].upper()]


def build(cls: type[Config], mapping: Mapping[str, object], where: str) -> Config:
    """Return a config dataclass, with nested ones, from a mapping such as parsed YAML.

    Missing fields keep their defaults. The only conversion is from int to float; a bool is not a
    number. Supported annotations are bool, int, float, str, ``Path``, ``Literal``, tuples (from
    lists), unions of these, and dataclasses of all. Inverse of :func:`to_mapping`.

    Args:
        where: Source of the mapping for messages, such as a file name.

    Raises:
        ConfigError: For an unknown key (the message names the nearest and all valid keys), a
            wrong type, or a value that the dataclass itself refuses.
    """
    return _build(cls, mapping, where, "", cls)


def to_mapping(config: object) -> dict[str, object]:
    """Return a config as plain mappings, lists, numbers and strings, ready for YAML.

    Class variables come first: they identify the kind of config.
    """
    assert dataclasses.is_dataclass(config), f"{config!r} is not a dataclass"
    names = (*_kind_names(type(config)), *(field.name for field in dataclasses.fields(config)))
    return {name: _plain(getattr(config, name)) for name in names}


def to_yaml(config: object) -> str:
    """Return all settings of a config, including defaults, as YAML."""
    return yaml.safe_dump(to_mapping(config), sort_keys=False, allow_unicode=True)


def written(value: object) -> str:
    """Return a plain value as YAML on one line.

    >>> written([0.5, 1.0]), written("on")
    ('[0.5, 1.0]', "'on'")
    """
    text = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=math.inf)
    return text.removesuffix("...\n").strip()


def overlay(base: Mapping[str, object], other: Mapping[str, object]) -> dict[str, object]:
    """Return the settings of ``base``, replaced by those of ``other`` section by section.

    >>> overlay({"sweep": {"steps": 9, "window": 5}}, {"sweep": {"steps": 15}})
    {'sweep': {'steps': 15, 'window': 5}}
    """
    merged = dict(base)
    for key, value in other.items():
        section = merged.get(key)
        if isinstance(section, Mapping) and isinstance(value, Mapping | None):
            merged[key] = overlay(section, value or {})  # an empty section changes nothing
        else:
            merged[key] = value
    return merged


def find_config(name_or_path: str | Path) -> Path:
    """Return the YAML file of a preset such as ``"paper"``, or an existing file.

    A text with a YAML suffix or a folder is a path; any other text is a preset's name.

    Raises:
        ConfigError: Unknown preset (the message names the nearest), or missing file.
    """
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml") or len(path.parts) > 1 or isinstance(name_or_path, Path):
        if not path.is_file():
            raise ConfigError(
                f"{path}: there is no such file; needed: a YAML file with settings, or one of the "
                f"presets {', '.join(presets())}."
            )
        return path
    if name_or_path not in presets():
        raise ConfigError(
            f"there is no preset {name_or_path!r}.{nearest(name_or_path, presets())} "
            f"Choose one of {', '.join(presets())}, or the path of a YAML file."
        )
    return _preset_folder() / f"{name_or_path}.yaml"


def presets() -> tuple[str, ...]:
    """Return the names of the presets of the package."""
    return tuple(sorted(path.stem for path in _preset_folder().glob("*.yaml")))


def read_mapping(path: Path | str) -> dict[str, object]:
    """Return the settings in a YAML file.

    Raises:
        ConfigError: The file is unreadable, not YAML, without ``key: value``, or has a key twice.
    """
    path = Path(path)
    try:
        if path.stat().st_size > 1_000_000:  # all settings with comments take 20 kB
            raise ConfigError(
                f"{path}: has {path.stat().st_size} bytes; needed: a YAML file with settings."
            )
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_OnceLoader)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}. Needed: a YAML text file.") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: is not valid YAML: {error}") from error
    except RecursionError as error:
        raise ConfigError(f"{path}: is nested too deeply; needed: settings in sections.") from error
    except (ValueError, TypeError, OverflowError, AttributeError) as error:
        # PyYAML's constructors of numbers and dates raise these.
        raise ConfigError(
            f"{path}: contains an invalid value ({shortened(str(error))}); needed: numbers, texts, "
            "lists and sections."
        ) from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(
            f"{path}: contains {_kind(content)}; needed: settings as `key: value`, in sections."
        )
    return content


class _OnceLoader(yaml.SafeLoader):
    """Safe YAML without repeated keys, the first of which would be lost silently.

    Aliases are also refused: nine lines of them can expand to more values than fit into memory.
    """

    def compose_node(  # the stubs' index is a number; it may also be a node, or nothing
        self,
        parent: yaml.Node | None,
        index: typing.Any,  # noqa: ANN401
    ) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.composer.ComposerError(
                problem="aliases (`*name`) are not supported; write out the value",
                problem_mark=self.peek_event().start_mark,  # type: ignore[no-untyped-call]
            )
        return super().compose_node(parent, index)

    def construct_mapping(
        self, node: yaml.MappingNode, deep: bool = False
    ) -> dict[Hashable, object]:
        keys = [key.value for key, _ in node.value]
        for index, key in enumerate(keys):
            if key in keys[:index]:
                raise yaml.constructor.ConstructorError(
                    problem=f"the key `{key}` occurs twice",
                    problem_mark=node.value[index][0].start_mark,
                )
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
            f"{where}: {section or 'the top level'} is {_described(mapping)}; "
            f"needed: a section with settings such as {', '.join(_names(cls))}."
        )
    hints, kinds = typing.get_type_hints(cls), _kind_names(cls)
    values: dict[str, typing.Any] = {}
    for key, value in mapping.items():
        if key in kinds:
            require(value == getattr(cls, key), f"{where}: {key}", value, repr(getattr(cls, key)))
            continue
        if key not in _names(cls):
            paths = [path for path in setting_paths(root) if path.rpartition(".")[2] == key]
            elsewhere = f" Did you mean `{'` or `'.join(paths)}`?"
            hint = elsewhere if paths else nearest(shortened(str(key)), _names(cls))
            parent = f"section `{section}`" if section else "the top level"
            raise ConfigError(
                f"{where}: {parent} has no setting `{shortened(str(key))}`.{hint} Its settings: "
                f"{', '.join(_names(cls))}."
            )
        kind, field = hints[key], _join(section, key)
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            values[key] = _build(kind, {} if value is None else value, where, field, root)
        else:
            values[key] = _convert(kind, value, f"{where}: {field}")
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {section + ': ' if section else ''}{error}") from error


def _convert(hint: object, value: object, field: str) -> object:
    """Return a YAML value as the annotated type of its field, or refuse it."""
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
                _convert(arg, item, f"{field}[{index}]")
                for index, (arg, item) in enumerate(zip(args, value, strict=True))
            )
    elif origin is Literal:
        if any(choice == value and type(choice) is type(value) for choice in args):
            return value
    elif hint is float:
        exponent = isinstance(value, str) and "e" in value.lower()
        # In YAML 1.1, 1e-3 without a dot is a text. An integer of 310 digits overflows a float.
        with suppress(ValueError, OverflowError):
            if type(value) in (int, float) or exponent:
                return float(value)  # type: ignore[arg-type]
    elif hint is Path and isinstance(value, str | Path):
        return Path(value)
    elif type(value) is hint:
        return value
    raise ConfigError(f"{field} is {_described(value)}; needed: {_needed(hint)}.")


def _described(value: object) -> str:
    return f"{shortened(repr(value))} ({_kind(value)})"


def nearest(key: str, valid: Sequence[str]) -> str:
    """Return a question that suggests the most similar valid name; empty if none is similar."""
    near = difflib.get_close_matches(key, valid, n=1, cutoff=0.5)
    return f" Did you mean `{near[0]}`?" if near else ""


def _names(cls: type[object]) -> tuple[str, ...]:
    assert dataclasses.is_dataclass(cls), f"{cls!r} is not a dataclass"
    return tuple(field.name for field in dataclasses.fields(cls) if field.init)


def _kind_names(cls: type[object]) -> tuple[str, ...]:
    """Return the class variables of a config, which identify its kind."""
    hints = typing.get_type_hints(cls)
    return tuple(name for name in hints if typing.get_origin(hints[name]) is typing.ClassVar)


def setting_paths(cls: type[object], section: str = "") -> Iterator[str]:
    """List all settings of a config, including nested ones, with dots between the names."""
    for name, hint in typing.get_type_hints(cls).items():
        yield _join(section, name)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            yield from setting_paths(hint, _join(section, name))


def _join(section: str, name: str) -> str:
    return f"{section}.{name}" if section else name


def _plain(value: object) -> object:
    if dataclasses.is_dataclass(value):
        return to_mapping(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _needed(hint: object) -> str:
    """Describe an annotation in the terms of YAML."""
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
