"""The publications that modules follow, from the ``Source`` lines of docstrings.

``sources`` writes a list for every subpackage.
"""

import ast
import dataclasses
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective, switch_source_input

import pimper_bench
import pimper_torch

PACKAGES = [Path(str(one.__file__)).parent for one in (pimper_torch, pimper_bench)]
SOURCE = re.compile(r"^Source: (.*?)(?:\n\n|\Z)", flags=re.MULTILINE | re.DOTALL)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """The source that one docstring states.

    Attributes:
        module: Whose docstring, such as ``pimper_torch.stages.photometry.cone``.
        name: Of the function or class; empty for the module itself.
        text: The citation, reStructuredText.
    """

    module: str
    name: str
    text: str


def sources() -> Iterator[Source]:
    """Find all sources, module by module."""
    for package, path in ((one, path) for one in PACKAGES for path in sorted(one.rglob("*.py"))):
        parts = path.relative_to(package.parent).with_suffix("").parts
        module = ".".join(parts).removesuffix(".__init__")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                found = SOURCE.search(inspect.cleandoc(ast.get_docstring(node) or ""))
                if found:
                    name = "" if isinstance(node, ast.Module) else node.name
                    yield Source(module=module, name=name, text=" ".join(found[1].split()))


def subpackages() -> dict[str, list[Source]]:
    """Group sources by subpackage."""
    groups: dict[str, list[Source]] = {}
    for source in sources():
        parts = source.module.removeprefix("pimper_torch.").split(".")
        subpackage = ".".join(parts[:-1][:2] or parts)
        groups.setdefault(subpackage, []).append(source)
    return groups


class Sources(SphinxDirective):
    """The directive."""

    def run(self) -> list[nodes.Node]:
        """Write a section of the page for each subpackage."""
        written: list[nodes.Node] = []
        for subpackage, found in subpackages().items():
            section = nodes.section(ids=[nodes.make_id(f"sources {subpackage}")])
            section += nodes.title("", "", nodes.literal("", subpackage))
            section += nodes.bullet_list("", *map(self.item, found))
            written.append(section)
        return written

    def item(self, source: Source) -> nodes.list_item:
        """Write one citation."""
        where = f"{source.module.removeprefix('pimper_torch.')}{'.' * bool(source.name)}"
        lines = StringList([f"``{where}{source.name}``: {source.text}"], source=source.module)
        item = nodes.list_item()
        with switch_source_input(self.state, lines):
            self.state.nested_parse(lines, 0, item)
        return item


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive ``sources``."""
    app.add_directive("sources", Sources)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
