"""Every setting of a chain, with its default and its effect, from the configs themselves.

``settings:: module.Class`` writes a table for each stage; names of stages behind it leave the
others out.
"""

import dataclasses
from importlib import import_module
from inspect import getdoc

import docstring_parser
import yaml
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective, switch_source_input

from pimper_torch.runtime.config import to_mapping

HEAD = "setting", "default", "effect"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """One setting.

    Attributes:
        name: As on the command line and in YAML, such as ``sweep.window``.
        default: As YAML writes it.
        effect: Its entry in the config's docstring.
    """

    name: str
    default: str
    effect: str


def settings_of(config: object, section: str = "") -> list[Setting]:
    """List the settings of a config, and of the configs inside it, in order."""
    assert dataclasses.is_dataclass(config), f"{config!r} is not a dataclass"
    described = docstring_parser.parse(getdoc(config) or "")
    effects = {one.arg_name: one.description or "" for one in described.params}
    found: list[Setting] = []
    for field in dataclasses.fields(config):
        name = f"{section}.{field.name}" if section else field.name
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            found += settings_of(value, name)
        else:
            default = written(to_mapping(config)[field.name])
            found.append(Setting(name=name, default=default, effect=effects[field.name]))
    return found


def sections(config: object) -> dict[str, list[Setting]]:
    """Group settings by the stage that they are of; those of the chain itself come first."""
    groups: dict[str, list[Setting]] = {}
    for setting in settings_of(config):
        stage, dot, _ = setting.name.partition(".")
        groups.setdefault(stage if dot else "", []).append(setting)
    return groups


def written(value: object) -> str:
    """Write a value as YAML has it; an empty text or list as two quotes or brackets."""
    return yaml.safe_dump(value, default_flow_style=True).removesuffix("\n...\n").strip()


class Settings(SphinxDirective):
    """The directive."""

    required_arguments = 1
    optional_arguments = 100

    def run(self) -> list[nodes.Node]:
        """Write a section of the page for each stage."""
        module, _, name = self.arguments[0].rpartition(".")
        groups = sections(getattr(import_module(module), name)())
        wanted = self.arguments[1:] or list(groups)
        written: list[nodes.Node] = []
        for stage in wanted:
            section = nodes.section(ids=[nodes.make_id(f"settings {stage or 'chain'}")])
            title = nodes.title("", "", nodes.literal("", stage) if stage else nodes.Text("Chain"))
            section += [title, self.table(groups[stage])]
            written.append(section)
        return written

    def table(self, settings: list[Setting]) -> nodes.table:
        """Write settings as rows: name, default, effect."""
        group = nodes.tgroup("", cols=3)
        group += [nodes.colspec(colwidth=width) for width in (30, 15, 55)]
        head = nodes.row("", *(cell(nodes.paragraph("", word)) for word in HEAD))
        body = nodes.tbody("", *map(self.row, settings))
        group += [nodes.thead("", head), body]
        return nodes.table("", group)

    def row(self, setting: Setting) -> nodes.row:
        """Write one setting."""
        name, default = (
            nodes.paragraph("", "", nodes.literal("", text))
            for text in (setting.name, setting.default)
        )
        effect = nodes.container()
        lines = StringList(setting.effect.splitlines(), source=f"docstring of {setting.name}")
        with switch_source_input(self.state, lines):
            self.state.nested_parse(lines, 0, effect)
        return nodes.row("", cell(name), cell(default), cell(*effect.children))


def cell(*content: nodes.Node) -> nodes.entry:
    """Write a cell of a table."""
    return nodes.entry("", *content)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive ``settings``."""
    app.add_directive("settings", Settings)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
