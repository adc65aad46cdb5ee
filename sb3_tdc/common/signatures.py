"""The parameters of a constructor, including those that it passes on."""

import inspect


def constructor_parameters(cls: type) -> dict[str, inspect.Parameter]:
    """
    Return the named parameters of a constructor, including those that it passes on as ``**kwargs``.

    :return: the parameters by name, including ``self``; those of a base class come first
    """
    found: dict[str, inspect.Parameter] = {}
    for base in cls.__mro__:
        if "__init__" in vars(base):
            parameters = inspect.signature(vars(base)["__init__"]).parameters
            named = {k: p for k, p in parameters.items() if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
            found = {**named, **found}
            if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
                break
    return found
