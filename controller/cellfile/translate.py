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


def resolved(node: dict[str, Any], root: dict[str, Any]) -> dict[str, Any]:
    """The node of the schema `root` that a reference points to."""
    if "$ref" in node:
        target: dict[str, Any] = root["$defs"][node["$ref"].rsplit("/", 1)[1]]
        return target
    return node


def mistakes_of(errors: list[ErrorDetails], source: Source) -> list[Mistake]:
    """pydantic's findings as mistakes with line, value, and what is allowed; each matter once."""
    located = [(_path_in_file(error["loc"], source), error) for error in errors]
    mistakes, missing = [], dict[KeyPath, list[str]]()
    meant = set[KeyPath]()  # what misspelt keys stand for: these are not also reported as missing
    for path, error in located:
        if error["type"] == "extra_forbidden" and (key := _nearest_key(path, source)) is not None:
            meant.add((*path[:-1], key))
    for path, error in located:
        if error["type"] == "too_short" and len(error["input"]) >= error["ctx"]["min_length"]:
            continue  # pydantic counts only elements that are in order; the others are reported themselves
        if error["type"] == "union_tag_not_found" and path in meant:
            continue
        if error["type"] != "missing" or isinstance(path[-1], int):
            mistakes.append(_mistake_of(error, path, source))
        elif not any(path[:length] in meant for length in range(1, len(path) + 1)):
            missing.setdefault(path[:-1], []).append(str(path[-1]))
    for path, keys in missing.items():
        if len(keys) == 1:
            mistakes.append(
                source.mistake((*path, keys[0]), "key is missing", _how_to_add((*path, keys[0]), source))
            )
        else:
            mistakes.append(source.mistake(path, f"keys are missing: {', '.join(keys)}", "add them"))
    return list(dict.fromkeys(mistakes))


def _mistake_of(error: ErrorDetails, path: KeyPath, source: Source) -> Mistake:
    kind, context = error["type"], error.get("ctx", {})
    if kind == "missing" or (kind == "too_long" and "prefixItems" in _node_at(path, source)):
        path = path[:-1] if kind == "missing" else path
        value = source.value(path)
        found = len(value) if isinstance(value, (list, tuple)) else 0
        return source.mistake(path, f"{found} values", f"write {len(_node_at(path, source)['prefixItems'])}")
    if kind == "extra_forbidden":
        return _unknown_key(path, source)
    if kind == "quantity":  # the value stands before the problem already
        problem = context["problem"].removeprefix(f"{shown(source.value(path))}: ")
        return source.mistake(path, problem, context["remedy"])
    if kind in _EXPECTED:
        return source.mistake(path, _EXPECTED[kind])
    if kind in _COMPARISONS:
        return source.mistake(path, *_out_of_bounds(kind, context, source.value(path)))
    if kind in ("literal_error", "union_tag_invalid"):
        if kind == "union_tag_invalid":
            path = (*path, context["discriminator"].strip("'"))
        return _not_allowed(path, source)
    if kind == "union_tag_not_found":
        key = context["discriminator"].strip("'")
        choices = ", ".join(shown(choice) for choice in _choices((*path, key), source))
        return source.mistake((*path, key), "key is missing", f"choose from {choices}")
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
            isinstance(step, str)
            and isinstance(here, dict)
            and step not in here
            and step in (here.get("kind"), here.get("driver"), here.get("task"))
        )
        if not is_tag or (is_last and step in _keys(path, source)):
            path += (step,)
    return path


def _node_at(path: KeyPath, source: Source) -> dict[str, Any]:
    """Schema of the value at a path of the file; {} if there is none."""
    node: dict[str, Any] = source.schema
    for position, step in enumerate(path):
        if isinstance(step, int):
            items = node.get("prefixItems")
            element = (items[step] if step < len(items) else {}) if items else node.get("items", {})
            node = resolved(element, source.schema)
        else:
            node = resolved(node.get("properties", {}).get(step, {}), source.schema)
        if "oneOf" in node:
            node = _chosen(node, source.value(path[: position + 1]), source.schema)
        if "anyOf" in node:  # optional
            node = resolved(node["anyOf"][0], source.schema)
    return node


def _chosen(union: dict[str, Any], table: object, root: dict[str, Any]) -> dict[str, Any]:
    """Schema of the table that `kind` or `driver` chooses; the union itself if they choose none."""
    tags, mapping = union["discriminator"], union["discriminator"]["mapping"]
    tag = table.get(tags["propertyName"]) if isinstance(table, dict) else None
    return resolved({"$ref": mapping[tag]}, root) if isinstance(tag, str) and tag in mapping else union


def _keys(path: KeyPath, source: Source) -> list[str]:
    return list(_node_at(path, source).get("properties", {}))


def _nearest_key(path: KeyPath, source: Source) -> str | None:
    """The key that a misspelt one stands for: rather one that is not there yet."""
    key, allowed = str(path[-1]), _keys(path[:-1], source)
    nearest = difflib.get_close_matches(key, _unused(path, source), n=1)
    return next(iter(nearest or difflib.get_close_matches(key, allowed, n=1)), None)


def _unused(path: KeyPath, source: Source) -> list[str]:
    table = source.value(path[:-1])
    return [name for name in _keys(path[:-1], source) if not isinstance(table, dict) or name not in table]


def _unknown_key(path: KeyPath, source: Source) -> Mistake:
    if (nearest := _nearest_key(path, source)) is not None:
        return source.mistake(path, "unknown key", f'did you mean "{nearest}"?')
    allowed = ", ".join(_unused(path, source) or _keys(path[:-1], source))
    return source.mistake(path, "unknown key", f"allowed: {allowed}" if allowed else "remove it")


def _how_to_add(path: KeyPath, source: Source) -> str:
    description = _node_at(path, source).get("description", "").split("\n")[0].rstrip(".")
    return f"add it ({description[:1].lower()}{description[1:]})" if description else "add it"


def _choices(path: KeyPath, source: Source) -> list[Any]:
    node = _node_at(path, source)
    tags = _node_at(path[:-1], source).get("discriminator", {}).get("mapping", {})  # of a union
    return node.get("enum") or ([node["const"]] if "const" in node else list(tags))


def _not_allowed(path: KeyPath, source: Source) -> Mistake:
    choices, value = _choices(path, source), source.value(path)
    words = [choice for choice in choices if isinstance(choice, str)]
    near = difflib.get_close_matches(value, words, n=1) if isinstance(value, str) else []
    remedy = f"did you mean {shown(near[0])}? " if near else ""
    all_choices = ", ".join(shown(choice) for choice in choices)
    return source.mistake(path, "not allowed", f"{remedy}choose from {all_choices}")


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
