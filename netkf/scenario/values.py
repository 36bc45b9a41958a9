"""Values of scenario keys on a command line: TOML expressions, or words without quotes."""

from __future__ import annotations

import re
from typing import Any

from netkf.core.errors import ScenarioError
from netkf.scenario.reading import parse_toml

MAX_WORD = 1000  # characters of a value that is not TOML and is taken as a text
MAX_SETTING = 100_000
"""Characters of a setting; Linux passes no argument of more than 131,071."""

SHORT_NUMBER = re.compile(r"[+-]?(?:\.\d+|\d+\.)(?:[eE][+-]?\d+)?", re.ASCII)
"""Numbers without a digit on one side of the point, which people type and TOML has not."""


def split_setting(option: str, setting: str) -> tuple[str, str]:
    """Return key path and text of ``key.path=value``; raises ScenarioError at ``option``."""
    _require_short(option, setting)
    key, equals, text = (part.strip() for part in setting.partition("="))
    if not equals or not key or not text:
        remedy = "write it that way"
        if equals and key:
            remedy = f"give a value; an empty text is written {key}='\"\"'"
        raise ScenarioError(option, "must be KEY.PATH=VALUE", setting, remedy)
    return key, text


def parse_value(option: str, key: str, text: str) -> Any:
    """Return the value of TOML, a number as ``.5``, or words without quotes (ScenarioError)."""
    try:
        return _parse_toml_value(text)
    except (ValueError, RecursionError):
        if text[0] in "[{\"'" or not text.isprintable() or len(text) > MAX_WORD:
            rule = f"value of {key} is not valid TOML"
            remedy = "correct it; quote the argument for your shell"
            raise ScenarioError(option, rule, text, remedy) from None
        return float(text) if SHORT_NUMBER.fullmatch(text) else text


def parse_values(option: str, key: str, text: str) -> list[Any]:
    """Return the values of ``v1,v2,...``, without splitting inside brackets and quotes."""
    _require_short(option, text)
    try:
        values = _parse_toml_value(f"[{text}]")
    except (ValueError, RecursionError):
        return [parse_value(option, key, item.strip() or " ") for item in _split_at_commas(text)]
    return list(values)


def _require_short(option: str, text: str) -> None:
    if len(text) > MAX_SETTING:
        rule = f"must have at most {MAX_SETTING:,} characters"
        raise ScenarioError(option, rule, len(text), "write long values into the file")


def _parse_toml_value(text: str) -> Any:
    table = parse_toml(f"value = {text}")
    if list(table) != ["value"]:  # the text has a line break and further keys
        raise ValueError
    return table["value"]


def _split_at_commas(text: str) -> list[str]:
    items, depth, open_quote = [""], 0, ""
    for character in text:
        if open_quote:
            open_quote = "" if character == open_quote else open_quote
        elif character in "\"'":
            open_quote = character
        if not open_quote:
            depth += (character in "[{") - (character in "]}")
        if character == "," and depth == 0 and not open_quote:
            items.append("")
        else:
            items[-1] += character
    return items
