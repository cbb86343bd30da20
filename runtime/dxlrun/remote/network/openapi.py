"""OpenAPI: the table of requests as a document for other programs (OpenAPI Specification 3.1).

Bodies and replies are JSON Schemas of the types that gateway and client use. Each request lists the roles
that may make it over TLS; the Unix socket of this user needs no certificate.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from types import NoneType
from typing import Any

import msgspec
import numpy as np

from dxlrun.remote.live.states import RobotStates
from dxlrun.remote.requests import request_table as requests
from dxlrun.remote.requests.replies import NotDone
from dxlrun.remote.requests.request_table import REQUESTS, Request, Role

_JSON = "application/json"
_TLS = "certificate"


def openapi(abouts: Mapping[Request[Any, Any], str]) -> dict[str, object]:
    """Return the OpenAPI document of all requests; `abouts` has the summary of each request."""
    answers = {one: RobotStates if one is requests.STATES else one.answer for one in REQUESTS}
    kinds = dict.fromkeys([NotDone, *(one.body for one in REQUESTS), *answers.values()])
    found, components = msgspec.json.schema_components(
        kinds, schema_hook=_schema, ref_template="#/components/schemas/{name}"
    )
    schemas = dict(zip(kinds, found, strict=True)) | {bytes: {}}
    paths: dict[str, dict[str, object]] = {}
    for one in REQUESTS:
        path = one.path.replace(":path", "")
        names = [word.partition("}")[0] for word in path.split("{")[1:]]
        given = [("path", name) for name in names] + [("query", name) for name in one.query]
        body = {"required": True, "content": {_JSON: {"schema": schemas[one.body]}}}
        kind = "application/octet-stream" if answers[one] is bytes else _JSON
        paths.setdefault(path, {})[one.method.lower()] = {
            "summary": abouts[one].splitlines()[0],
            "parameters": [
                {"name": name, "in": where, "required": where == "path", "schema": {"type": "string"}}
                for where, name in given
            ],
            **({} if one.body is NoneType else {"requestBody": body}),
            "security": [{_TLS: [role.name.lower()]} for role in Role if role >= one.role],
            "responses": {
                "2XX": {"description": "done", "content": {kind: {"schema": schemas[answers[one]]}}},
                "default": {"description": "refused", "content": {_JSON: {"schema": schemas[NotDone]}}},
            },
        }
    return {
        "openapi": "3.1.0",
        "info": {"title": "dxlrun", "version": version("dxlrun")},
        "paths": paths,
        "components": {
            "schemas": components,
            "securitySchemes": {
                _TLS: {"type": "mutualTLS", "description": "TLS 1.3; the role is the OU of the certificate"}
            },
        },
    }


def _schema(kind: object) -> dict[str, object]:
    """Return the JSON Schema of a type that msgspec cannot describe: numbers for an array, else any JSON."""
    if getattr(kind, "__origin__", None) is np.ndarray:
        return {"type": "array", "description": "numbers; null: not known"}
    return {"description": "any JSON"}
