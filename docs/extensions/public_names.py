"""The exported names of the package, with the first lines of their docstrings, as links."""

from inspect import getdoc, ismodule

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective, switch_source_input

import pimper_torch


def lines() -> list[str]:
    """Write the table: a link to each name, and its first line."""
    written = [".. list-table::", "   :widths: 30 70", ""]
    for name in sorted(pimper_torch._names, key=str.lower):
        value = getattr(pimper_torch, name)
        if not ismodule(value):
            written.append(f"   * - :py:obj:`{name} <{value.__module__}.{value.__qualname__}>`")
            written.append(f"     - {(getdoc(value) or '').splitlines()[0]}")
    return written


class PublicNames(SphinxDirective):
    """The directive."""

    def run(self) -> list[nodes.Node]:
        """Write the table."""
        found = nodes.container()
        source = StringList(lines(), source="pimper_torch")
        with switch_source_input(self.state, source):
            self.state.nested_parse(source, 0, found)
        return list(found.children)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive ``public-names``."""
    app.add_directive("public-names", PublicNames)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
