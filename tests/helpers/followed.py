"""Static check of names and calls in Python snippets against the packages."""

import ast
import functools
import inspect
import types
import typing
from collections.abc import Callable

from torch import nn

import pimper_torch as pt
from pimper_torch.presets.load_chain import make_chain
from pimper_torch.presets.load_config import load_config


def _own(kind: object) -> bool:
    """Return whether a module, a class or a function belongs to the packages."""
    name = kind.__name__ if inspect.ismodule(kind) else getattr(kind, "__module__", None) or ""
    return name.partition(".")[0] in (pt.__name__, "pimper_bench")


class Of:
    """An object known only by its class, or by a few possible ones."""

    def __init__(self, kinds: object) -> None:
        union = typing.get_origin(kinds) in (typing.Union, types.UnionType)
        told = typing.get_args(kinds) if union else [kinds]
        self.kinds = [kind for kind in told if inspect.isclass(kind) and _own(kind)]


# Types of variables in documents.
VARIABLES = {
    "pt": pt,
    "chain": Of(pt.CoarseToFine | pt.Published),
    "result": Of(pt.Reconstruction),
    "scene": Of(pt.SparseScene),
    "step": Of(pt.Step),
    "views": Of(pt.Views),
}
_EXPORTED = {name: getattr(pt.stages, name) for name in dir(pt.stages)} | {
    name: getattr(pt, name) for name in pt.__all__
}


def follow(text: str) -> None:
    """Resolve the names of a Python snippet, and bind the arguments of its calls.

    Its imports are executed, and its settings loaded. Objects are followed if annotations give
    their classes; others are not checked.

    Raises:
        SyntaxError: It is not valid Python.
        ImportError: A module, or a name in it, does not exist.
        AttributeError: An object of the package has no such attribute.
        TypeError: A call does not match a signature.
        ConfigError: Settings, or names of stages, that the chain refuses.
    """
    held: dict[str, object] = {**_EXPORTED, **VARIABLES}
    for statement in ast.parse(text).body:
        _followed(statement, held)


def _followed(node: ast.AST, held: dict[str, object]) -> object:
    """Return the value or type of an expression, if known; record the bindings of a statement."""
    if isinstance(node, ast.Name):
        return held.get(node.id)
    if isinstance(node, ast.Attribute):
        return _attribute(_followed(node.value, held), node.attr)
    if isinstance(node, ast.Import | ast.ImportFrom):
        exec(compile(ast.Module([node], []), "imports", "exec"), held)
        return None
    parts = [_followed(part, held) for part in ast.iter_child_nodes(node)]
    if isinstance(node, ast.Call):
        return _called(parts[0], node)
    bound = node.targets if isinstance(node, ast.Assign) else []
    for name in (target for target in bound if isinstance(target, ast.Name)):
        held[name.id] = parts[-1]
    return None


def _attribute(owner: object, name: str) -> object:
    if inspect.ismodule(owner) or inspect.isclass(owner):
        return getattr(owner, name) if _own(owner) else getattr(owner, name, None)
    if not isinstance(owner, Of) or not owner.kinds:
        return None
    having = [kind for kind in owner.kinds if hasattr(kind, name) or name in _assigned(kind)]
    if not having:
        raise AttributeError(f"{owner.kinds[0].__name__} has no {name}")
    found = inspect.getattr_static(having[0], name, None)
    if isinstance(found, property):
        return Of(_hints(found.fget).get("return"))
    if inspect.isfunction(found):
        return functools.partial(found, None)
    return Of(_hints(having[0]).get(name))


def _assigned(kind: type) -> set[str]:
    """Return names that a class annotates, and those that a module assigns in its constructor."""
    own = [one for one in kind.__mro__ if _own(one)]
    names = {name for one in own for name in inspect.get_annotations(one)}
    if issubclass(kind, nn.Module):
        names |= {name for one in own for name in one.__init__.__code__.co_names}
    return names


def _called(function: object, call: ast.Call) -> object:
    if isinstance(function, Of):
        return Of(_hints(function.kinds[0].forward).get("return")) if _module(function) else None
    plain = function.func if isinstance(function, functools.partial) else function
    if not (inspect.isfunction(plain) or inspect.isclass(plain)) or not _own(plain):
        return None
    starred = any(isinstance(one, ast.Starred) for one in call.args)
    positional = [] if starred else [None] * len(call.args)
    named = {keyword.arg: None for keyword in call.keywords if keyword.arg}
    inspect.signature(function).bind_partial(*positional, **named)
    if plain is pt.load_chain:
        _load(call)
    return Of(plain if inspect.isclass(plain) else _hints(plain).get("return"))


def _module(function: Of) -> bool:
    return bool(function.kinds) and issubclass(function.kinds[0], nn.Module)


def _load(call: ast.Call) -> None:
    """Check the settings of a call with the loader, and its stages with the chain."""
    parameters = ("name_or_path", "changes", "observer", "cache")
    given = dict(zip(parameters, call.args, strict=False))
    given |= {keyword.arg: keyword.value for keyword in call.keywords if keyword.arg}
    settings = []
    for name, otherwise in (("name_or_path", "default"), ("changes", {})):
        try:
            settings.append(ast.literal_eval(given[name]))
        except (KeyError, ValueError):  # computed
            settings.append(otherwise)
    stages = {name: nn.Identity() for name in given if name not in parameters}
    make_chain(load_config(*settings), **stages)


def _hints(annotated: Callable[..., object] | type) -> dict[str, object]:
    try:
        return typing.get_type_hints(annotated)
    except NameError:  # imported only for type checkers
        return {}
