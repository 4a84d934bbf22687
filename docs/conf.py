"""Build the documentation: ``sphinx-build -W docs site``. Nothing is downloaded."""

import shutil
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "extensions"))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from sphinx.application import Sphinx

from pimper_torch.io.version import installed_version

project = "pimper_torch"
author = "the authors of pimper_torch"
release = installed_version()

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "mathml",
    "public_names",
    "settings",
    "sources",
]
exclude_patterns = ["extensions", "static"]

# Notebooks are pages with their stored outputs. Sphinx reads files of this folder only.
NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
shutil.copytree(NOTEBOOKS, Path(__file__).parent / "notebooks", dirs_exist_ok=True)
nb_execution_mode = "off"
nb_merge_streams = True

# Of autodoc: docstrings are in Google's form with reStructuredText inside.
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_maximum_signature_line_length = 88

# Of pages: formulas between dollars, and headings as targets of links, both as GitHub has them.
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = f"pimper_torch {release}"
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["filter.js"]
html_copy_source = False
html_show_copyright = False


def setup(app: Sphinx) -> None:
    """Escape the asterisk of shapes with several axes, such as ``*batch``, after napoleon."""
    app.connect("autodoc-process-docstring", escape_types, priority=900)
    app.connect("source-read", link_notebooks)


def link_notebooks(app: Sphinx, page: str, source: list[str]) -> None:
    """Point links between documents and notebooks at their pages on the site."""
    source[0] = source[0].replace("](../notebooks/", "](notebooks/").replace("](../docs/", "](../")


def escape_types(
    app: Sphinx, what: str, name: str, value: object, options: object, lines: list[str]
) -> None:
    """Escape asterisks in types of attributes, which would start emphasis."""
    for index, line in enumerate(lines):
        if line.startswith((":vartype ", "   :type ")):
            lines[index] = line.replace("*", "\\*")
