"""What a system says of itself, from the table of callbacks: its methods, its signatures and its documentation."""

import inspect
import re
import textwrap
from collections.abc import Callable
from typing import Any

from twoloop.kernels.compile.callbacks import KINDS

# in a docstring, which is indented as it stands in the source, and since Python 3.13 is not
PLACE = re.compile(r"^( *)\{callbacks\}\n", re.MULTILINE)


def add_callbacks(cls: Any) -> Any:
    """Give a class a method for each kind of callback, and name all of them where it is made."""
    for kind in KINDS:
        setattr(cls, kind, _method(kind))
    plain = cls.from_python.__func__
    cls.__signature__, plain.__signature__ = _complete(cls), _complete(plain)
    cls.__doc__, plain.__doc__ = _documented(cls.__doc__, False), _documented(plain.__doc__, True)
    return cls


def _method(kind: str) -> Callable[..., Any]:
    """The method of a system that evaluates one kind of callback."""
    entry = KINDS[kind]
    parameters = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in ("t", *entry.state)]
    signature = inspect.Signature(parameters)

    def method(self: Any, *arguments: Any, **named: Any) -> Any:
        if named or len(arguments) != len(parameters):
            try:
                arguments = signature.bind(*arguments, **named).args
            except TypeError as error:
                raise TypeError(f"{kind}{signature}: {error}") from None
        return self.evaluate(kind, *arguments)

    own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    method.__signature__ = signature.replace(parameters=[own, *parameters])  # type: ignore[attr-defined]
    method.__name__, method.__qualname__ = kind, f"ConstrainedSystem.{kind}"
    method.__doc__ = f"{entry.meaning[0].upper()}{entry.meaning[1:]}, {entry.size}.\n\nSee `evaluate`."
    return method


def _documented(text: str | None, plain: bool) -> str | None:
    """A docstring with the callbacks in their place; None without docstrings, by python -OO."""
    return text and PLACE.sub(lambda place: "".join(_entry(kind, plain, place[1]) for kind in KINDS), text)


def _entry(kind: str, plain: bool, indent: str) -> str:
    """A kind among the parameters of a docstring."""
    entry = KINDS[kind]
    called = f"{kind}({', '.join(('t', *entry.state))}) -> {entry.size}: " if plain else ""
    text = f"{called}{entry.meaning}{'' if plain else ', ' + entry.size}. {entry.note}"
    if plain and kind == "mass":
        text += " Or an array: a constant matrix, factored once."
    head = f"{kind} : {'callable' if plain else 'compiled callback'}{', optional' if entry.optional else ''}"
    body = textwrap.fill(text, 120, initial_indent=indent + "    ", subsequent_indent=indent + "    ")
    return f"{indent}{head}\n{body}\n"


def _complete(function: Any) -> inspect.Signature:
    """The signature of what makes a system, with the callbacks by name."""
    own = inspect.signature(function).parameters.values()
    keyword = inspect.Parameter.KEYWORD_ONLY
    defaults = {kind: None if entry.optional else inspect.Parameter.empty for kind, entry in KINDS.items()}
    callbacks = [inspect.Parameter(kind, keyword, default=default) for kind, default in defaults.items()]
    needed = [each for each in own if each.default is each.empty and each.kind != each.VAR_KEYWORD]
    options = [each for each in own if each.default is not each.empty]
    return inspect.Signature([*needed, *callbacks, *options])
