"""The reference of the cell file, from the schema: `python -m controller.cellfile.document`."""

from collections.abc import Iterator
from typing import Any, Final

from controller.cellfile.translate import resolved, schema
from controller.quantities import DIMENSIONS, FORMATTERS, shown

INTRODUCTION: Final = """\
# The cell file

<!-- Written by `python -m controller.cellfile.document > docs/cell-file.md`; edit the schema instead. -->

`cell.toml` says what stands in a cell and what it shall do. It is a [TOML](https://toml.io) file;
`cells/bench-block/cell.toml` is a complete one. `truecell check` reads it and reports every mistake with
its line; nothing starts with a file that has one.

- A quantity is text with its unit, `"12.5 mm"`; a bare number is refused. Decimal point, no comma.
- `_u` at the end of a key means a standard uncertainty (one sigma).
- Unknown keys are refused. A key without a default must be there.
- Frames: the arm stands on `base` and carries `flange`, on which laser and probe are mounted; plate, bar,
  sphere and part are placed in `base`. `xyz` and `rpy` together are the transform from the frame to its
  `parent`.
- `port` and `cad` are relative to the folder of the cell file unless they begin with `/`.
- The digest in results is taken from all values in SI units and from the CAD file: comments, layout and the
  choice of units do not change it.

## Units

| Quantity | Units |
| --- | --- |
"""


def document() -> str:
    """The page, in Markdown."""
    units = "".join(
        f"| {dimension.name.split(' ', 1)[1]} | {', '.join(f'`{unit}`' for unit in dimension.units)} |\n"
        for dimension in DIMENSIONS
    )
    tables = "".join(
        section
        for name, node in schema()["properties"].items()
        for section in _sections(f"[{name}]", resolved(node, schema()))
    )
    return f"{INTRODUCTION}{units}{tables}"


def _sections(header: str, node: dict[str, Any]) -> Iterator[str]:
    """The sections of a table, or those of each table of a union, one after the other."""
    if "oneOf" not in node:
        yield from _tables(header, node)
        return
    tags = node["discriminator"]
    for tag, reference in tags["mapping"].items():
        first, *others = _tables(header, resolved({"$ref": reference}, schema()))
        yield first.replace(f"`{header}`", f'`{header}` with `{tags["propertyName"]} = "{tag}"`', 1)
        yield from others


def _tables(header: str, node: dict[str, Any]) -> Iterator[str]:
    """One section for the table, then one for each table inside it."""
    required, inner = node.get("required", []), []
    rows = ""
    for key, value in node["properties"].items():
        below = header.strip("[]") + f".{key}"
        if (table := resolved(value, schema())).get("type") == "object":
            inner.append((f"[{below}]", table))
        elif (table := resolved(value.get("items", {}), schema())) and {"oneOf", "properties"} & set(table):
            inner.append((f"[[{below}]]", table))
        else:
            default = "required" if key in required else _default(value)
            rows += f"| `{key}` | {_type(value)} | {_meaning(value)} | {default} |\n"
    description = " ".join(node.get("description", "").split())
    yield f"\n## `{header}`\n\n{description}\n"
    if rows:
        yield f"\n| Key | Value | Meaning | Default |\n| --- | --- | --- | --- |\n{rows}"
    for name, table in inner:
        yield from _sections(name, table)


def _meaning(node: dict[str, Any]) -> str:
    return " ".join(node.get("description", "").split()).replace("|", "\\|")


def _default(node: dict[str, Any]) -> str:
    default = node.get("default")
    if default is None or default in ([], ()):
        return "none"
    if (quantity := node.get("quantity")) is not None:
        return f'`"{FORMATTERS[quantity](default)}"`'
    return f"`{shown(default)}`"


def _type(node: dict[str, Any]) -> str:
    """The kind of value and its bounds, in words."""
    node = resolved(node["anyOf"][0], schema()) if "anyOf" in node else resolved(node, schema())
    if "enum" in node or "const" in node:
        return " or ".join(f"`{shown(choice)}`" for choice in node.get("enum", [node.get("const")]))
    if "prefixItems" in node:
        first = _type(node["prefixItems"][0])
        return f"array of {len(node['prefixItems'])}: {first}"
    if node.get("type") == "array":
        least = f"at least {node['minItems']}: " if node.get("minItems") else ""
        return f"array of {least}{_type(node.get('items', {}))}"
    quantity: str | None = node.get("quantity")
    if quantity is not None:
        return quantity.split(" ", 1)[1] + _bounds(node, FORMATTERS[quantity])
    words = {"string": "text", "integer": "whole number", "boolean": "`true` or `false`"}
    return ("date" if node.get("format") == "date" else words.get(node.get("type", ""), "text")) + _bounds(
        node, str
    )


def _bounds(node: dict[str, Any], formatted: Any) -> str:
    bounds = [
        f"{words} {formatted(node[key])}"
        for key, words in (
            ("minimum", "at least"),
            ("exclusiveMinimum", "above"),
            ("maximum", "at most"),
            ("exclusiveMaximum", "below"),
        )
        if key in node
    ]
    return f", {', '.join(bounds)}" if bounds else ""


if __name__ == "__main__":
    print(document(), end="")
