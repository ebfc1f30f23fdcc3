"""Scenarios: named, frozen, validated values with units in their field names.

A scenario says everything about an environment that a user may choose. Each field carries its allowed values, so a bad
value fails with a message that names field, value and what would be right, and documentation can be generated.
"""

from __future__ import annotations

import ast
import dataclasses
import difflib
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

S = TypeVar("S", bound="Scenario")


def number(default: float, low: float, high: float, doc: str) -> Any:
    """A real field in [low, high]; units stand in the field's name."""
    return field(default=default, metadata={"kind": "number", "low": low, "high": high, "doc": doc})


def integer(default: int, low: int, high: int, doc: str) -> Any:
    """An integer field in [low, high]."""
    return field(default=default, metadata={"kind": "integer", "low": low, "high": high, "doc": doc})


def choice(default: str, options: tuple[str, ...], doc: str) -> Any:
    """A field that takes one of some names."""
    return field(default=default, metadata={"kind": "choice", "options": options, "doc": doc})


def flag(default: bool, doc: str) -> Any:
    """A field that is True or False."""
    return field(default=default, metadata={"kind": "flag", "doc": doc})


def free(default: Any, doc: str) -> Any:
    """A field checked elsewhere (a file path, a user's object)."""
    return field(default=default, metadata={"kind": "free", "doc": doc})


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """Base of all scenarios: validates every field when made.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if isinstance(value, (np.number, np.bool_)):  # of a parameter sweep
                value = value.item()
                object.__setattr__(self, f.name, value)
            _check(type(self).__name__, f.name, value, f.metadata)

    def replace(self: S, **changes: Any) -> S:
        """A copy with some fields changed; an unknown field is a TypeError that suggests the nearest name."""
        known = {f.name for f in dataclasses.fields(self)}
        for name in changes:
            if name not in known:
                close = difflib.get_close_matches(name, known, n=1)
                hint = f"did you mean {close[0]!r}?" if close else f"known fields: {', '.join(sorted(known))}"
                raise TypeError(f"{type(self).__name__} has no field {name!r}; {hint}")
        return dataclasses.replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Field values that can be written to a file (objects by their representation)."""
        plain = (int, float, str, bool, type(None))
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: value if isinstance(value, plain) else repr(value) for name, value in values.items()}


def parse_fields(texts: Iterable[str]) -> dict[str, Any]:
    """Fields written as ``name=value``, as on a command line; values are Python literals or else plain words.

    Raises:
        ValueError: no equals sign, or a name given twice.
    """
    fields: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (equals and name):
            raise ValueError(f"{text!r}: must be a scenario field and its value, NAME=VALUE")
        if name in fields:
            raise ValueError(f"{text!r}: {name} is given twice")
        fields[name] = _literal(value)
    return fields


def _literal(text: str) -> Any:
    words = {"true": True, "false": False, "none": None}
    if text.lower() in words:
        return words[text.lower()]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def _check(owner: str, name: str, value: Any, rule: Any) -> None:
    kind = rule.get("kind", "free")
    if kind == "choice" and not (isinstance(value, str) and value in rule["options"]):
        raise ValueError(f"{owner}.{name} = {value!r}: must be one of {', '.join(map(repr, rule['options']))}")
    if kind == "flag" and not isinstance(value, bool):
        raise ValueError(f"{owner}.{name} = {value!r}: must be True or False")
    if kind not in ("number", "integer"):
        return
    numeric = isinstance(value, int) or (kind == "number" and isinstance(value, float))
    if isinstance(value, bool) or not numeric:
        raise ValueError(f"{owner}.{name} = {value!r}: must be {'an integer' if kind == 'integer' else 'a number'}")
    if not rule["low"] <= value <= rule["high"]:  # NaN compares False
        raise ValueError(f"{owner}.{name} = {value!r}: must lie in [{rule['low']}, {rule['high']}]")
