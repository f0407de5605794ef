"""What /openapi.json says beyond what routes say of themselves: headers, and what a refusal looks like."""

from typing import Any

from fastapi import FastAPI

REPLY_HEADERS = {
    "ETag": "names these bytes; given back as If-None-Match it is answered with 304 while they are the same",
    "Gi-Volume": "one JSON object: origin (centre of voxel 0, 0, 0) [m], voxel_size [m], shape, dtype, basis, unit, scale (texel x scale = "
    "unit), sectors, valid (share of voxels in free air), expected_error (median, of light near surfaces, from the dataset's report; null "
    "without one), cascade; of an interior volume also rooms and rooms_reached",
    "Gi-Residual": "what later bounces could still add, as a share of a sector's brightest value",
    "Gi-Distant": "JSON: origin_sector, origin (north-west corner) [m], sector_size [m], shape, dtype, basis, light, unit, scale",
    "Gi-Tick": "the tick in which the volume was filled",
    "Gi-Boxes": "how many moving boxes reach into the volume; left out when none does",
    "Content-Range": "which of how many bytes",
}
_PROBLEM = {
    "type": "object",
    "required": ["title", "status", "code", "detail"],
    "properties": {
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "code": {"type": "string", "description": "stable, for programs"},
        "detail": {"type": "string", "description": "one line: where, what was expected, what was found"},
        "errors": {"type": "array", "items": {"type": "object"}, "description": "of bad parameters, each by itself"},
    },
}
_REFUSED = {
    "4XX": "The request is wrong, and changed nothing.",
    "503": "The live world is starting (`Retry-After` says when to ask again), or a file of the dataset is damaged.",
}
NOT_CHANGED: dict[int | str, dict[str, Any]] = {304: {"description": "what If-None-Match names is still so"}}


def reply(*media_types: str, headers: tuple[str, ...] = (), more: dict[int | str, dict[str, Any]] | None = None) -> dict[int | str, Any]:
    """``responses`` of a route whose body is no JSON: its media types, its headers by their names in REPLY_HEADERS, other statuses."""
    described = {name: {"description": REPLY_HEADERS[name], "schema": {"type": "string"}} for name in headers}
    content: dict[str, Any] = {media: {} for media in media_types}
    return {200: {"content": content, "headers": described}, **(more or {})}


def describe(app: FastAPI) -> None:
    """Let ``app.openapi()`` tell of problems as they are sent, in place of those that the framework would send."""
    plain = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = plain()
            schemas = schema["components"]["schemas"]
            for name in ("HTTPValidationError", "ValidationError"):
                schemas.pop(name, None)
            schemas["Problem"] = _PROBLEM
            content = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
            for path, operations in schema["paths"].items():
                for operation in operations.values():
                    operation["responses"].pop("422", None)
                    # What operators ask for takes no engine and no world: nothing of it is unavailable.
                    statuses = _REFUSED if path.startswith("/v1") else ("4XX",)
                    operation["responses"] |= {status: {"description": _REFUSED[status], "content": content} for status in statuses}
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]
