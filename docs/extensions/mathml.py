"""Formulas as MathML, which browsers show without a script."""

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

ENVIRONMENT = r"\begin{aligned}%s\end{aligned}"


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer ``mathml``."""
    app.add_html_math_renderer("mathml", (inline, None), (displayed, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def inline(translator: HTML5Translator, node: nodes.math) -> None:
    """Write a formula in a line."""
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def displayed(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula in a line of its own."""
    text = node.astext()
    several = r"\\" in text and r"\begin" not in text
    formula = convert(ENVIRONMENT % text if several else text, display="block")
    translator.body.append(f'<div class="formula">{formula}</div>')
    raise nodes.SkipNode
