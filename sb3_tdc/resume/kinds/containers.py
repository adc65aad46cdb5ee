"""Kinds for lists, tuples, dictionaries, sets, deques: existing mutable ones are filled in place, and stay shared."""

import json
from collections import Counter, OrderedDict, defaultdict, deque
from typing import Any

from sb3_tdc.resume.kinds.objects import is_made_in_python, loaded_class
from sb3_tdc.resume.walk import MISSING, Capture, NotCapturedError, NotRestoredError, Restore, head, name_of

# Longer lists of numbers are stored as arrays
_LONG = 64
# Classes of dictionaries that can be created from their name
_DICTS = {name_of(kind): kind for kind in (dict, OrderedDict, Counter, defaultdict)}
# Kinds of values that stay equal when they are captured and restored: these can be keys, and members of sets
_VALUES = {"value", "integer", "text", "bytes", "number", "enum", "code", "same", "known"}
_TUPLES = {"tuple", "frozenset", "named tuple"}


def items_of(content: list[Any]) -> dict[str, Any]:
    """Return the children of a list."""
    return {f"[{i}]": node for i, node in enumerate(content)}


def capture_items(context: Capture, value: Any, path: str) -> list[Any]:
    """Capture the items of a list or another sequence."""
    return [context.capture(item, f"{path}[{i}]") for i, item in enumerate(value)]


def restore_items(context: Restore, content: list[Any], there: list[Any], path: str) -> list[Any]:
    """
    Restore the items of a list or tuple.

    :param there: the items in the same places now
    """
    there = there + [MISSING] * (len(content) - len(there))
    return [
        context.restore(node, item, f"{path}[{i}]") for i, (node, item) in enumerate(zip(content, there, strict=False))
    ]


def restore_list(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore a list, in place if there is one."""
    there = list(existing) if type(existing) is list else []
    value = existing if type(existing) is list and context.claims(existing) else []
    context.begin(value)
    value[:] = restore_items(context, content, there, path)
    return value


def is_long_list_of_numbers(value: Any) -> bool:
    """Return whether a value is a list that can be stored as an array."""
    if type(value) is not list or len(value) <= _LONG:
        return False
    kinds = {type(item) for item in value}
    return kinds in ({float}, {bool}) or (kinds == {int} and max(map(abs, value)) < 1 << 63)


def restore_numbers(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore a list of numbers, in place if there is one."""
    value = existing if type(existing) is list and context.claims(existing) else []
    value[:] = context.array(content).tolist()
    return value


def restore_tuple(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Return a new tuple."""
    return tuple(restore_items(context, content, list(existing) if type(existing) is tuple else [], path))


# ---------------------------------------------------------------- named tuples


def is_named_tuple(value: Any) -> bool:
    """Return whether a value is of a class made by ``namedtuple`` or ``NamedTuple``."""
    return isinstance(value, tuple) and type(value).__bases__ == (tuple,) and hasattr(type(value), "_fields")


def capture_named_tuple(context: Capture, value: Any, path: str) -> Any:
    """Return the name of the class, and the items."""
    return [name_of(type(value)), capture_items(context, value, path)]


def restore_named_tuple(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Return a new named tuple."""
    name, items = content
    is_there = name_of(type(existing)) == name
    kind = type(existing) if is_there else loaded_class(name, tuple)
    if kind is None or not hasattr(kind, "_fields"):
        raise NotRestoredError(f"{path} was a {name}, and is a {name_of(type(existing))}")
    return tuple.__new__(kind, restore_items(context, items, list(existing) if is_there else [], path))


def needs_of_named_tuple(content: Any) -> str | None:
    """Return the class if it is not found in an imported module, and so must already exist; else None."""
    return None if loaded_class(content[0], tuple) else f"a {content[0]}"


# ---------------------------------------------------------------- dictionaries


def is_dict(value: Any) -> bool:
    """Return whether a value is a dictionary of a known class, or of one made in Python."""
    known = (*_DICTS.values(), object)
    return isinstance(value, dict) and all(c in known or is_made_in_python(c) for c in type(value).__mro__)


def capture_dict(context: Capture, value: dict[Any, Any], path: str) -> Any:
    """Return the class, the items, the attributes, and the default factory of a dictionary."""
    items = []
    for key, item in dict.items(value):
        node = context.capture(key, f"{path} (a key)")
        if not _is_value(context, node, key):
            raise NotCapturedError(f"{path} has {_describe(key)} as a key")
        items.append([node, context.capture(item, f"{path}[{key!r}]")])
    content: dict[str, Any] = {"class": name_of(type(value)), "items": items}
    if attributes := getattr(value, "__dict__", {}):
        content["attributes"] = context.capture_attributes(attributes, path)
    if isinstance(value, defaultdict):
        content["factory"] = context.capture(value.default_factory, f"{path}.default_factory")
    return content


def restore_dict(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore a dictionary, in place if there is one."""
    name = content["class"]
    is_there = name_of(type(existing)) == name
    there: dict[Any, Any] = dict(dict.items(existing)) if is_there else {}
    if is_there and context.claims(existing):
        value = existing
    elif name in _DICTS:
        value = _DICTS[name]()
    else:
        raise NotRestoredError(f"{path} was a {name}, and is a {name_of(type(existing))}")
    context.begin(value)
    items = []
    for key_node, node in content["items"]:
        with context.names():
            key = context.restore(key_node, MISSING, path)
        items.append((key, context.restore(node, there.get(key, MISSING), f"{path}[{key!r}]")))
    kind = OrderedDict if isinstance(value, OrderedDict) else dict  # not the methods that a subclass overrides
    kind.clear(value)
    for key, item in items:
        kind.__setitem__(value, key, item)
    context.restore_attributes(content.get("attributes", {}), value, path)
    if isinstance(value, defaultdict):
        factory = existing.default_factory if is_there else MISSING
        value.default_factory = context.restore(content["factory"], factory, f"{path}.default_factory")
    return value


def needs_of_dict(content: Any) -> str | None:
    """Return the class if it cannot be created from its name; else None."""
    return None if content["class"] in _DICTS else f"a {content['class']}"


def children_of_dict(content: Any) -> dict[str, Any]:
    """Return the items, the attributes, and the default factory of a dictionary."""
    children = {f"[{json.dumps(key)}]": node for key, node in content["items"]}
    children |= {f".{name}": node for name, node in content.get("attributes", {}).items()}
    return {**children, ".default_factory": content.get("factory")}


def _is_value(context: Capture, node: Any, value: Any) -> bool:
    """Return whether a key or a member of a set will be found by its value after it is restored."""
    if not isinstance(node, dict):
        return value == value  # false for NaN
    tag, content = head(node)
    if tag not in ("same", "known") and context.kinds[tag].needs(content) is not None:
        return False
    if tag in _TUPLES:
        return all(_is_value(context, part, item) for part, item in zip(_members(node), _in_order(value), strict=True))
    return tag in _VALUES and bool(value == value)


def _members(node: dict[str, Any]) -> list[Any]:
    tag, content = head(node)
    return content[1] if tag == "named tuple" else content


def _in_order(value: Any) -> list[Any]:
    return sorted(value, key=repr) if isinstance(value, frozenset) else list(value)


def _describe(value: Any) -> str:
    return repr(value) if value != value else f"a {name_of(type(value))}"


# ---------------------------------------------------------------- sets and deques


def capture_set(context: Capture, value: Any, path: str) -> Any:
    """Return the members of a set, in an order that does not depend on the process."""
    members = sorted(value, key=repr)
    nodes = capture_items(context, members, path)
    for node, member in zip(nodes, members, strict=True):
        if not _is_value(context, node, member):
            raise NotCapturedError(f"{path} has {_describe(member)} as a member")
    return nodes


def restore_set(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore a set, in place if there is one."""
    value = existing if type(existing) is set and context.claims(existing) else set()
    members = restore_items(context, content, [], path)
    value.clear()
    value.update(members)
    return value


def capture_deque(context: Capture, value: Any, path: str) -> Any:
    """Return the maximum length and the items of a deque."""
    return [value.maxlen, capture_items(context, value, path)]


def restore_deque(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Restore a deque, in place if there is one with this maximum length."""
    maxlen, items = content
    there = list(existing) if type(existing) is deque else []
    is_there = type(existing) is deque and existing.maxlen == maxlen
    value = existing if is_there and context.claims(existing) else deque(maxlen=maxlen)
    context.begin(value)
    restored = restore_items(context, items, there, path)
    value.clear()
    value.extend(restored)
    return value
