"""The page /docs: what /openapi.json says, to be read. Nothing of it comes from elsewhere, so it shows where there is no internet."""

import json
import re
from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

_HEAD = """<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Sectorlight: HTTP reference</title><link rel="stylesheet" href="viewer/viewer.css"><link rel="icon" href="data:,"></head>
<body class="reference"><h1>Sectorlight: HTTP reference</h1>
"""


def reference_page(schema: Mapping[str, Any]) -> str:
    """An OpenAPI description as HTML."""
    parts = [_HEAD, _text(schema["info"].get("description", "")), '<p>For programs: <a href="openapi.json">openapi.json</a>.</p><nav><ul>']
    operations = [(method.upper(), path, found) for path, methods in schema["paths"].items() for method, found in methods.items()]
    parts += [f'<li><a href="#{_anchor(method, path)}">{method} {escape(path)}</a></li>' for method, path, _ in operations]
    parts.append("</ul></nav>")
    for method, path, operation in operations:
        parts.append(f'<section id="{_anchor(method, path)}"><h2>{method} {escape(path)}</h2>{_text(operation.get("description", ""))}')
        if operation.get("security"):
            parts.append("<p>Wants the token, where the server has one.</p>")
        rows = [_parameter(parameter) for parameter in operation.get("parameters", ())]
        body = operation.get("requestBody", {}).get("content", {}).get("application/json")
        if body:
            rows += [_member(name, facts, body["schema"]) for name, facts in body["schema"]["properties"].items()]
        parts.append(_table(rows))
        if body:
            parts.append(f"<p>Body, JSON: {_code(json.dumps(body['example']))}</p>")
        parts.append(_table(_replies(operation["responses"], schema)) + "</section>")
    return "".join(parts) + "</body></html>"


def _anchor(method: str, path: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", f"{method} {path}".lower()).strip("-")


def _text(text: str) -> str:
    return "".join(f"<p>{_words(part)}</p>" for part in text.split("\n\n"))


def _words(text: str) -> str:
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text, quote=False))


def _code(value: Any) -> str:
    return f"<code>{escape(str(value), quote=False)}</code>"


def _table(rows: list[tuple[str, str, str]]) -> str:
    cells = ("".join(f"<td>{cell}</td>" for cell in row) for row in rows)
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>" if rows else ""


def _parameter(parameter: Mapping[str, Any]) -> tuple[str, str, str]:
    schema = parameter["schema"]
    default = schema.get("default")
    needed = "needed" if parameter["required"] else "" if default is None else f"else {_code(str(default).lower())}"
    return _code(parameter["name"]), needed, f"{_text(parameter.get('description', ''))}{_limits(schema)}"


def _limits(schema: Mapping[str, Any]) -> str:
    """What a value may be: its type, its choices, its range."""
    found = []
    for kind in (kind for kind in schema.get("anyOf", [schema]) if kind.get("type") != "null"):
        choices = kind.get("enum", [kind["const"]] if "const" in kind else [])
        low, high = kind.get("minimum", kind.get("exclusiveMinimum")), kind.get("maximum")
        within = "" if low is None else f", {'above ' if 'exclusiveMinimum' in kind else ''}{low:g}..{high:g}"
        longest = f", at most {kind['maxLength']} characters" if "maxLength" in kind else ""
        found.append(" ".join(_code(choice) for choice in choices) or f"{kind['type']}{within}{longest}")
    return f"<p>{' '.join(found)}</p>"


def _member(name: str, facts: Mapping[str, Any], schema: Mapping[str, Any]) -> tuple[str, str, str]:
    return _code(name), "needed" if name in schema.get("required", ()) else "", _text(facts["description"])


def _replies(responses: Mapping[str, Any], schema: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    rows = []
    for status, reply in responses.items():
        media = " ".join(_code(name) for name in reply.get("content", {}))
        said = "" if reply["description"] == "Successful Response" else _text(reply["description"])
        rows.append((status, media, said + "".join(_members(reply.get("content", {}), schema))))
        rows += [("", _code(name), _text(header["description"])) for name, header in reply.get("headers", {}).items()]
    return rows


def _members(content: Mapping[str, Any], schema: Mapping[str, Any]) -> Iterator[str]:
    """The members of a JSON reply, with what they mean where that is said."""
    reference = content.get("application/json", {}).get("schema", {}).get("$ref", "")
    if reference:
        properties = schema["components"]["schemas"][reference.rsplit("/", 1)[-1]].get("properties", {})
        for name, facts in properties.items():
            meaning = facts.get("description", "")
            yield f"{_code(name)}{': ' if meaning else ''}{_words(meaning)}<br>"
