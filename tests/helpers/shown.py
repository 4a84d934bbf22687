"""Code in documents, with its lines."""

import ast
import doctest
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

# Excludes targets of roles, :func:`load_views`.
_SPAN = re.compile(r"(?<![`:])(`{1,2})(?!`)([^`]+)\1(?!`)")
_ROLE = re.compile(r":(?:func|class|mod|meth|attr|data|exc):`[~!]?(?:[^`<]+<)?([^`>]+)>?`")
_FENCE = re.compile(r" *```([^\s`]*)[^`]*$")
_DIRECTIVE = re.compile(r"(?:\.\. code-block:: (\S+)|(?!\.\. ).*::)$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """A piece of code in a document.

    Attributes:
        line: Its first line, from 1.
        language: Language of a block, possibly empty; ``None`` for inline code.
    """

    line: int
    text: str
    language: str | None = None


def shown_in(path: Path) -> Iterator[Shown]:
    """Find code in Markdown, reStructuredText, a notebook's text or Python strings."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        for number, cell in enumerate(json.loads(text)["cells"]):
            if cell["cell_type"] == "markdown":
                found = in_markdown("".join(cell["source"]))
                yield from (Shown(line=number, text=x.text, language=x.language) for x in found)
    elif path.suffix == ".py":
        for line, string in strings(ast.parse(text)):
            yield from in_string(line, string)
    else:
        yield from (in_restructured if path.suffix == ".rst" else in_markdown)(text)


def in_markdown(text: str) -> Iterator[Shown]:
    """Find fenced or indented blocks, and inline code."""
    lines = text.split("\n")
    at = 0
    while at < len(lines):
        fence, first = _FENCE.match(lines[at]), at
        if fence:
            at = next(end for end in range(at + 1, len(lines)) if _FENCE.match(lines[end]))
            block = "\n".join(lines[first + 1 : at])
            yield Shown(line=first + 2, text=block, language=fence[1])
            at += 1
        elif lines[at].startswith("    ") and not (at and lines[at - 1].strip()):
            at = _behind(lines, at)
            yield Shown(line=first + 1, text="\n".join(lines[first:at]).rstrip(), language="")
        else:
            yield from in_sentence(first + 1, lines[at])
            at += 1


def in_restructured(text: str) -> Iterator[Shown]:
    """Find code blocks, literal blocks, and inline code."""
    lines = text.split("\n")
    at = 0
    while at < len(lines):
        block = _DIRECTIVE.match(lines[at])
        yield from in_sentence(at + 1, lines[at])
        at += 1
        if block:
            first, at = at, _behind(lines, at)
            yield Shown(line=first + 1, text="\n".join(lines[first:at]), language=block[1] or "")


def _behind(lines: list[str], at: int) -> int:
    """Return the line after a block of indented lines."""
    return next((i for i in range(at, len(lines)) if re.match(r" {0,3}\S", lines[i])), len(lines))


def in_sentence(line: int, sentence: str) -> Iterator[Shown]:
    """Find code between backticks."""
    return (Shown(line=line, text=span[2]) for span in _SPAN.finditer(sentence))


def in_string(line: int, string: str) -> Iterator[Shown]:
    """Find examples and code between backticks, possibly across lines."""
    examples = doctest.DocTestParser().get_examples(string) if ">>>" in string else []
    if examples:
        code = "".join(example.source for example in examples)
        yield Shown(line=line + examples[0].lineno, text=code, language="python")
    for span in _SPAN.finditer(string):
        place = line + string.count("\n", 0, span.start())
        yield Shown(line=place, text=" ".join(span[2].split()))


def strings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """List the strings of a module with their lines; formatted values become an ellipsis."""
    inner = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            inner.update(map(id, node.values))
            parts = (x.value if isinstance(x, ast.Constant) else "…" for x in node.values)
            yield node.lineno, "".join(map(str, parts))
        elif (
            isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inner
        ):
            yield node.lineno, node.value


def roles_in(text: str) -> Iterator[tuple[int, str]]:
    """List the targets of Sphinx roles in a text, with their lines."""
    for role in _ROLE.finditer(text):
        yield text.count("\n", 0, role.start()) + 1, re.sub(r"\s", "", role[1])


def commands_in(block: str) -> Iterator[tuple[int, str]]:
    """List the commands of a block, after a prompt or ``&&``, with their lines in it."""
    joined = re.sub(r"\\\n *", "", block)
    for line, content in enumerate(joined.split("\n")):
        for command in content.split("&&"):
            yield line, command.strip().removeprefix("$ ")
