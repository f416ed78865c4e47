"""TOML files as frozen settings; an unknown key or a wrong type is one clear line."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from magbridge.errors import ConfigError, FormatError
from magbridge.files import contents, existing
from magbridge.wording import suggestion

__all__ = ["Table", "check_entries", "convert", "load_toml"]

T = TypeVar("T")
MAX_SIZE = 10_000_000
"""Largest TOML file that is read, bytes."""
MAX_DEPTH = 100
"""Deepest nesting of arrays, tables and keys that is read: the parser is recursive, or quadratic, in it."""
NESTED = re.compile(rf"[\w\"' -]+(?:\.[\w\"' -]+){{{MAX_DEPTH},}}")
"""A dotted key that is nested too deeply."""


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the file: its fields are the only keys it may have."""


def load_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file; raise :class:`ConfigError` where it is missing or not TOML."""
    too_deep = f"expected keys, arrays and tables at most {MAX_DEPTH} deep"
    try:
        if existing(Path(path)).stat().st_size > MAX_SIZE:
            raise ConfigError(path, "", f"expected a TOML file of at most {MAX_SIZE // 10**6} MB")
        text = contents(path).decode("utf-8-sig")
        if not text.strip():
            raise ConfigError(path, "", "expected a TOML file, got an empty file")
        if any(line.count(".") > MAX_DEPTH and NESTED.match(line.lstrip(" [")) for line in text.splitlines()):
            raise ConfigError(path, "", too_deep)
        return tomllib.loads(text)
    except RecursionError:
        raise ConfigError(path, "", too_deep) from None
    except FormatError as error:
        raise ConfigError(path, "", error.expected) from error
    except UnicodeDecodeError as error:
        raise ConfigError(path, "", "expected text in UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(path, "", f"expected TOML, got text that is not TOML: {error}") from error


def check_entries(table: Mapping[str, Any], key: str, kind: Any, path: str | Path, prefix: str = "") -> None:
    """Check the entries of the table `key` one by one, so that an error names the entry.

    :func:`convert` of the whole table would not name it.

    ConfigError: as :func:`convert`.
    """
    entries = table.get(key)
    for name, value in entries.items() if isinstance(entries, dict) else ():
        convert(value, kind, path, f"{prefix}{key}.{name}.")


def convert(table: Any, kind: type[T], path: str | Path, prefix: str = "") -> T:
    """Convert a table or value of a TOML file to `kind`; ConfigError: names the key, after `prefix`."""
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        sentence, _, where = str(error).partition(" - at ")
        keys = where.strip("`").removeprefix("$").lstrip(".")
        if match := re.match(r"Object (contains unknown|missing required) field `([^`]*)`", sentence):
            sentence = "missing key"
            if "unknown" in match[1]:
                sentence = "unknown key" + suggestion(match[2], _valid(kind, keys))
            keys = f"{keys}.{match[2]}".lstrip(".")
        elif match := re.match("Invalid enum value (.*)", sentence):
            sentence = f"expected one of {', '.join(_valid(kind, keys))}, not {match[1]}"
        elif (match := re.match(r"([\w.]+): ", sentence)) and match[1].split(".")[0] in _valid(kind, keys):
            keys, sentence = f"{keys}.{match[1]}".lstrip("."), sentence[match.end() :]
        elif re.match("Expected (?!.*, got)", sentence) and (value := _value(table, keys)) is not None:
            sentence += f", got {value!r}"
        raise ConfigError(path, f"{prefix}{keys}".rstrip("."), sentence[0].lower() + sentence[1:]) from error


def _value(table: Any, keys: str) -> Any:
    """Return the value at the dotted path `keys`; None if the path has the unknown entry ``[...]``."""
    for key in re.findall(r"[^.[\]]+|\.\.\.", keys):
        entries = dict(enumerate(table)) if isinstance(table, list) else table
        table = entries.get(int(key) if key.isdigit() else key) if isinstance(entries, dict) else None
    return table


def _valid(kind: Any, keys: str) -> list[str]:
    """Return the valid keys of a table, or the listed values, at the dotted path `keys` in `kind`."""
    tables = [inspect.type_info(kind)]
    for key in [*filter(None, re.split(r"\.|(?=\[)", keys)), None]:
        unions = [one.types if isinstance(one, inspect.UnionType) else [one] for one in tables]
        tables = [part for parts in unions for part in parts]
        if key is None:
            break
        tables = [inner for one in tables for inner in _entries(one, key)]
    fields = [field for one in tables if isinstance(one, inspect.StructType) for field in one.fields]
    values = [value for one in tables if isinstance(one, inspect.LiteralType) for value in one.values]
    return [field.encode_name for field in fields] or list(map(repr, values))


def _entries(table: inspect.Type, key: str) -> list[inspect.Type]:
    """Return the types that the entry `key` of a table may have."""
    if isinstance(table, inspect.StructType):
        return [field.type for field in table.fields if field.encode_name == key]
    if isinstance(table, inspect.DictType):
        return [table.value_type]
    return [table.item_type] if isinstance(table, inspect.ListType) else []
