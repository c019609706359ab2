"""pydantic's findings in the words of the cell file."""

import difflib
from functools import cache
from typing import Any, Final

from pydantic_core import ErrorDetails

from controller.cellfile.cell import Cell
from controller.cellfile.lines import KeyPath
from controller.cellfile.mistakes import Mistake, Source
from controller.quantities import dimension_of, format_as, shown

_EXPECTED: Final = {
    "string_type": "must be text in quotes",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "tuple_type": "must be an array",
    "date_type": "must be a date such as 2026-03-02",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
    "dict_type": "must be a table",
}
_COMPARISONS: Final = {
    "greater_than": ("gt", "more than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


@cache
def schema() -> dict[str, Any]:
    """JSON schema of the cell file, by the names of the file."""
    return Cell.model_json_schema(by_alias=True)


def resolved(node: dict[str, Any]) -> dict[str, Any]:
    """The schema node that a reference points to."""
    if "$ref" in node:
        target: dict[str, Any] = schema()["$defs"][node["$ref"].rsplit("/", 1)[1]]
        return target
    return node


def mistake_of(error: ErrorDetails, source: Source) -> Mistake:
    """One finding of pydantic as a mistake with line, value, and what is allowed."""
    kind, context = error["type"], error.get("ctx", {})
    path = _path_in_file(error["loc"], source)
    if kind == "missing" and error["loc"] and isinstance(error["loc"][-1], int):
        node = _node_at(path[:-1], source)
        wanted = len(node.get("prefixItems", ())) or node.get("minItems", 1)
        value = source.value(path[:-1])
        found = len(value) if isinstance(value, (list, tuple)) else 0
        return source.mistake(path[:-1], f"{found} values", f"write {wanted}")
    if kind == "missing":
        return source.mistake(path, "key is missing", _what_is_wanted(path, source))
    if kind == "extra_forbidden":
        return _unknown_key(path, source)
    if kind == "quantity":
        # the value stands before the colon already
        return source.mistake(
            path, context["problem"].removeprefix(f"{shown(source.value(path))}: "), context["remedy"]
        )
    if kind in _EXPECTED:
        return source.mistake(path, _EXPECTED[kind])
    if kind in _COMPARISONS:
        return source.mistake(path, *_out_of_bounds(kind, context, source.value(path)))
    if kind in ("literal_error", "union_tag_invalid"):
        if kind == "union_tag_invalid":
            path = (*path, context["discriminator"].strip("'"))
        return _not_allowed(path, source)
    if kind == "union_tag_not_found":
        return source.mistake((*path, context["discriminator"].strip("'")), "key is missing")
    if kind in ("too_short", "too_long"):
        wanted = context.get("min_length", context.get("max_length"))
        relation = "at least" if kind == "too_short" else "at most"
        found = context.get("actual_length") or len(error["input"])
        return source.mistake(path, f"{found} values", f"write {relation} {wanted}")
    if kind in ("string_too_short", "string_too_long", "string_pattern_mismatch"):
        return source.mistake(path, *_bad_text(kind, context))
    return source.mistake(path, error["msg"][:1].lower() + error["msg"][1:])


def _path_in_file(location: tuple[int | str, ...], source: Source) -> KeyPath:
    """Without the tags of unions, which pydantic puts between keys."""
    path: KeyPath = ()
    for position, step in enumerate(location):
        here = source.value(path)
        is_last = position == len(location) - 1
        is_tag = (
            isinstance(step, str) and isinstance(here, dict) and step not in here and step == here.get("kind")
        )
        if not is_tag or (is_last and step in _keys(path, source)):
            path += (step,)
    return path


def _node_at(path: KeyPath, source: Source) -> dict[str, Any]:
    """Schema of the value at a path of the file; {} if there is none."""
    node: dict[str, Any] = schema()
    for position, step in enumerate(path):
        if isinstance(step, int):
            items = node.get("prefixItems")
            node = resolved((items[step] if step < len(items) else {}) if items else node.get("items", {}))
            if "oneOf" in node:
                element = source.value(path[: position + 1])
                tag = element.get("kind") if isinstance(element, dict) else None
                mapping = node["discriminator"]["mapping"]
                node = resolved({"$ref": mapping[tag]}) if isinstance(tag, str) and tag in mapping else node
        else:
            node = resolved(node.get("properties", {}).get(step, {}))
        if "anyOf" in node:  # optional
            node = resolved(node["anyOf"][0])
    return node


def _keys(path: KeyPath, source: Source) -> list[str]:
    return list(_node_at(path, source).get("properties", {}))


def _unknown_key(path: KeyPath, source: Source) -> Mistake:
    key, allowed = str(path[-1]), _keys(path[:-1], source)
    table = source.value(path[:-1])
    unused = [name for name in allowed if not isinstance(table, dict) or name not in table]
    nearest = difflib.get_close_matches(key, unused, n=1) or difflib.get_close_matches(key, allowed, n=1)
    if nearest:
        return source.mistake(path, "unknown key", f'did you mean "{nearest[0]}"?')
    return source.mistake(path, "unknown key", f"allowed: {', '.join(unused or allowed)}")


def _what_is_wanted(path: KeyPath, source: Source) -> str:
    node = _node_at(path, source)
    description = node.get("description", "").split("\n")[0].rstrip(".")
    table = source.value(path[:-1])
    typos = [key for key in table if key not in _keys(path[:-1], source)] if isinstance(table, dict) else []
    near = difflib.get_close_matches(str(path[-1]), typos, n=1)
    if near:
        return f'is it "{near[0]}"?'
    return f"add it ({description[:1].lower()}{description[1:]})" if description else "add it"


def _not_allowed(path: KeyPath, source: Source) -> Mistake:
    node, value = _node_at(path, source), source.value(path)
    allowed = node.get("enum", [node["const"]] if "const" in node else [])
    if not allowed:  # the tag of a union
        allowed = list(_node_at(path[:-1], source).get("discriminator", {}).get("mapping", {}))
    near = difflib.get_close_matches(value, allowed, n=1) if isinstance(value, str) else []
    remedy = f"did you mean {shown(near[0])}? " if near else ""
    return source.mistake(
        path, "not allowed", remedy + f"allowed: {', '.join(shown(choice) for choice in allowed)}"
    )


def _out_of_bounds(kind: str, context: dict[str, Any], value: object) -> tuple[str, str]:
    name, words = _COMPARISONS[kind]
    limit, dimension = context[name], dimension_of(value)
    if dimension is not None and isinstance(value, str):
        unit = value.strip().lstrip("+-.0123456789eE").strip()
        limit = format_as(limit, dimension, unit if unit in dimension.units else dimension.usual_unit)
    return "out of bounds", f"must be {words} {limit}"


def _bad_text(kind: str, context: dict[str, Any]) -> tuple[str, str]:
    if kind == "string_too_short":
        return "empty", "write some text"
    if kind == "string_too_long":
        return "too long", f"write at most {context['max_length']} characters"
    if context["pattern"] == "^[0-9]+$":
        return "not a number in quotes", "write digits only"
    return (
        "not a name",
        "begin with a letter or digit; then letters, digits, space, underscore, dot and hyphen",
    )
