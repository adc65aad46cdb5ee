"""
Conversion of YAML and RL Zoo's Python notation to plain values, and of plain values to YAML.

Every file and argument is read here; nothing is evaluated. Numbers follow YAML 1.2: ``1e-3`` is a number, also inside a
list or a mapping (PyYAML reads YAML 1.1, where it is a text).
"""

import ast
import re
from typing import Any

import yaml

from sb3_tdc.common.untrusted import escaped

_FLOAT = "tag:yaml.org,2002:float"
_MERGE = "tag:yaml.org,2002:merge"
_PYTHON = "tag:yaml.org,2002:python"
_NUMBER = re.compile(
    r"[-+]?(?:[0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*|[0-9][0-9_]*(?=[eE]))(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)"
)


def _resolvers(base: Any) -> dict[str, Any]:
    return {
        first: [(tag, pattern) for tag, pattern in resolvers if tag != _FLOAT]
        for first, resolvers in base.yaml_implicit_resolvers.items()
    }


class _Loader(yaml.SafeLoader):
    """Loader of plain values, and of ordered mappings and tuples in RL Zoo's run folders. It refuses repeated keys."""

    yaml_implicit_resolvers = _resolvers(yaml.SafeLoader)

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != _MERGE:
                if (key.tag, key.value) in seen:
                    raise yaml.YAMLError(f"line {key.start_mark.line + 1} gives {escaped(key.value, 60)} a second time")
                seen.add((key.tag, key.value))
        return node


class _Dumper(yaml.SafeDumper):
    """Dumper that quotes texts which the loader would take for numbers, and writes shared values in full each time."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    yaml_implicit_resolvers = _resolvers(yaml.SafeDumper)


def _construct_sequence(loader: Any, node: Any) -> list[Any]:
    return loader.construct_sequence(node, deep=True)


def _construct_mapping(loader: Any, node: Any) -> dict[str, Any]:
    return dict(*_construct_sequence(loader, node))


for _class in (_Loader, _Dumper):
    _class.add_implicit_resolver(_FLOAT, re.compile(rf"(?:{_NUMBER.pattern})\Z"), list("-+0123456789."))
_Loader.add_constructor(f"{_PYTHON}/object/apply:collections.OrderedDict", _construct_mapping)
_Loader.add_constructor(f"{_PYTHON}/tuple", _construct_sequence)


class _UntrustedLoader(_Loader):
    """Loader that refuses aliases and merges, by which a few lines can stand for billions of values."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not read from a run folder")
        return super().compose_node(parent, index)

    def flatten_mapping(self, node: Any) -> None:
        if any(key.tag == _MERGE for key, _ in node.value):
            raise yaml.YAMLError("merges are not read from a run folder")


def load(text: str, where: str, is_trusted: bool = True) -> Any:
    """
    Read a YAML document of plain values.

    :param where: the file or the argument, for the error
    :param is_trusted: whether the document may have aliases and merges, by which a few lines can stand for billions of
        values
    :raises ValueError: if the text is not such a document
    """
    try:
        return yaml.load(text, _Loader if is_trusted else _UntrustedLoader)
    except (yaml.YAMLError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{where} is not YAML of plain values: {' '.join(str(error).split())}") from error


def dump(value: Any, **options: Any) -> str:
    """
    Write plain values as YAML that :func:`load` reads back.

    :param options: keyword arguments of ``yaml.dump``
    """
    return yaml.dump(value, Dumper=_Dumper, **options)


def read_notation(text: str) -> Any:
    """
    Read RL Zoo's Python notation: literals, ``dict(key=value)``, and dotted names, which stay texts (``nn.ReLU``).

    :raises ValueError: if the text is anything else
    """
    try:
        return _literal(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, RecursionError, MemoryError) as error:
        raise ValueError(f"it is not a Python literal: {text!r}") from error


def _literal(node: ast.expr) -> Any:
    match node:
        case ast.Constant(value=None | bool() | int() | float() | str()):
            return node.value
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=ast.Constant(value=int() | float() as number)):
            return -number if isinstance(node.op, ast.USub) else number
        case ast.List() | ast.Tuple():
            return [_literal(item) for item in node.elts]
        case ast.Dict() if all(isinstance(key, ast.Constant) for key in node.keys):
            keys = [_literal(key) for key in node.keys if key is not None]
            return dict(zip(keys, map(_literal, node.values), strict=True))
        case ast.Call(func=ast.Name(id="dict"), args=[]) if all(keyword.arg for keyword in node.keywords):
            return {keyword.arg: _literal(keyword.value) for keyword in node.keywords}
        case ast.Name() | ast.Attribute(value=ast.Name() | ast.Attribute()):
            return ast.unparse(node)
    raise ValueError(f"{ast.unparse(node)!r} is neither a literal nor dict(key=literal)")
