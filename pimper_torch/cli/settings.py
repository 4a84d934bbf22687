"""``pimper config``: print the settings of a preset as YAML, or explain some of them."""

import dataclasses
import textwrap
import typing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pimper_torch.cli.arguments import meanings, options_of, read_arguments, summary
from pimper_torch.cli.output import Output
from pimper_torch.presets.load_config import Config, load_config
from pimper_torch.runtime.config import nearest, presets, setting_paths, to_mapping, written
from pimper_torch.runtime.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Arguments of ``config``; an empty ``path`` is the complete preset."""

    preset: str
    config: Config
    path: tuple[str, ...] = ()


def run(job: _Job, output: Output) -> None:
    """Run ``config``."""
    value: object = to_mapping(job.config)
    for name in job.path:
        assert isinstance(value, dict)
        value = value[name]
    lines = [f"# {job.preset}: {summary(type(job.config))}"] * (not job.path)
    if not isinstance(value, dict):
        name = f"--{'.'.join(job.path).replace('_', '-')}"
        for option in options_of(job.config, ","):
            if name == option.names[0]:
                lines.append(f"# option: {', '.join(option.names)} {option.value}".rstrip())
        value = {".".join(job.path): value}
    output.emit("\n".join([*lines, *_yaml(job.config, job.path)]).lstrip("\n"))
    output.result(settings=value)


def checked(command: str, arguments: Sequence[str]) -> _Job:
    """Read the arguments, and check that the preset or setting exists."""

    def config(
        name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")] = "",
        preset: str = "default",
    ) -> _Job:
        """Print the settings of a preset as YAML with their meaning, or explain one.

        The output is a valid `--preset`, also with lines deleted: `pimper config > mine.yaml`.

        Args:
            name: A preset to print (default, fast, paper, or a YAML file); or a section or a
                setting to explain, such as sweep or fuse.terms.
            preset: Preset whose values an explained section or setting has.
        """
        is_preset = name in presets() or Path(name).suffix in (".yaml", ".yml")
        preset = name if is_preset else preset
        settings = load_config(preset)
        path = () if is_preset or not name else tuple(name.replace("-", "_").split("."))
        _require_setting(settings, path, name)
        return _Job(preset=preset, config=settings, path=path)

    return read_arguments(config, command, arguments)


def _require_setting(settings: object, path: Sequence[str], name: str) -> None:
    paths = ["", *setting_paths(type(settings))]
    if ".".join(path) not in paths:
        ends = [other for other in paths if other.endswith(f".{path[-1]}")]
        hint = f" Did you mean `{ends[0]}`?" if ends else nearest(name, [*paths, *presets()])
        raise ConfigError(
            f"there is no setting or preset `{name}`.{hint} `pimper config` prints all settings."
        )


def _yaml(settings: object, path: Sequence[str], depth: int = 0) -> Iterator[str]:
    """Yield lines of YAML with the meaning above each setting; only of ``path`` if given."""
    texts, indent = meanings(type(settings)), "  " * depth
    for name in typing.get_type_hints(type(settings)):
        value = getattr(settings, name)
        if path and name != path[0]:
            continue
        if dataclasses.is_dataclass(value):
            yield ""
            yield from _comment(summary(type(value)).split("\n\n")[0], indent)
            yield f"{indent}{name}:"
            yield from _yaml(value, path[1:], depth + 1)
        else:
            yield from _comment(texts.get(name, ""), indent)
            yield f"{indent}{name}: {written(to_mapping(settings).get(name, value))}"


def _comment(text: str, indent: str) -> list[str]:
    start = f"{indent}# "
    return textwrap.wrap(text, 96, initial_indent=start, subsequent_indent=start)
