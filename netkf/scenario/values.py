"""Values of scenario keys on a command line: TOML, or bare words."""

from __future__ import annotations

from typing import Any

from netkf.core.errors import ScenarioError
from netkf.scenario.reading import parse_toml

MAX_WORD = 1000
MAX_SETTING = 100_000
"""Characters of a setting; Linux passes no argument of more than 131,071."""


def split_setting(option: str, setting: str) -> tuple[str, str]:
    """Return key path and text of ``key.path=value``; raises ScenarioError at the ``option``."""
    _require_short(option, setting)
    key, equals, text = (part.strip() for part in setting.partition("="))
    if not equals or not key or not text:
        remedy = "write it that way"
        if equals and key:
            remedy = f"give a value; an empty text is written {key}='\"\"'"
        raise ScenarioError(option, "must be KEY.PATH=VALUE", setting, remedy)
    return key, text


def typed_value(option: str, key: str, text: str) -> Any:
    """Return the value of a text: TOML, or a string for bare words."""
    try:
        return _parse_value(text)
    except (ValueError, RecursionError):
        if text[0] in "[{\"'" or not text.isprintable() or len(text) > MAX_WORD:
            rule = f"value of {key} is not valid TOML"
            remedy = "correct it; quote the argument for your shell"
            raise ScenarioError(option, rule, text, remedy) from None
        return text


def typed_values(option: str, key: str, text: str) -> list[Any]:
    """Return the values of ``v1,v2,...``; commas inside brackets and quotes separate nothing."""
    _require_short(option, text)
    try:
        values = _parse_value(f"[{text}]")
    except (ValueError, RecursionError):
        return [typed_value(option, key, part.strip() or " ") for part in _split_list(text)]
    return list(values)


def _require_short(option: str, text: str) -> None:
    """Raise ScenarioError for a setting that is too long."""
    if len(text) > MAX_SETTING:
        rule = f"must have at most {MAX_SETTING:,} characters"
        raise ScenarioError(option, rule, len(text), "write long values into the file")


def _parse_value(text: str) -> Any:
    """Return the value of a TOML expression."""
    table = parse_toml(f"value = {text}")
    if list(table) != ["value"]:
        raise ValueError
    return table["value"]


def _split_list(text: str) -> list[str]:
    """Return the parts of a text between its commas, except those in quotes and brackets."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        depth += (letter in "[{") - (letter in "]}") if not quote else 0
        if letter == "," and depth == 0 and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return parts
