"""`GET /v1/metadata` and `GET /v1/openapi.json`: the metadata as JSON, and the schema of `POST /v1/actions`."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from turbopi.config import MOST_GUIDANCE
from turbopi.realtime.messages import MAX_TOKENS, NOTE_KINDS, NOTES, PREFIX
from turbopi.serve.http_api import ACTIONS, JSON, KINDS, MSGPACK, REFUSED
from turbopi.serve.json_messages import to_json
from turbopi.serve.options import MAX_CONTROL_HZ, MAX_DEADLINE_MS
from turbopi.serve.requests import MAX_BATCH_ROWS
from turbopi.serve.scheduling.schedule import PRIORITIES
from turbopi.support.action_groups import names_of
from turbopi.version import turbopi_version

_TEXT, _YES, _NUMBER = {"type": "string"}, {"type": "boolean"}, {"type": "number"}
_NUMBERS = {"type": "array", "description": "numbers, nested lists of one shape"}
_COUNT = {"type": "integer", "minimum": 0}
OPTIONS: dict[str, dict[str, Any]] = {  # a request's keys behind "turbopi/", which are the server's
    "model_actions": _YES,
    "previous": _NUMBERS,
    "anchor": _NUMBERS,
    "delay": _COUNT,
    "execution_horizon": _COUNT,
    "mode": _TEXT,
    "schedule": _TEXT,
    "max_guidance_weight": _NUMBER,
    "session": _TEXT,
    "step": _COUNT,
    "reset": _YES,
    "guidance": {"type": "number", "minimum": 0, "maximum": MOST_GUIDANCE},
    "seed": _COUNT,
    "observe": _YES,
    "subtask": _TEXT,
    "generate": {"type": ["boolean", "string"]},
    "max_tokens": {"type": "integer", "minimum": 1, "maximum": MAX_TOKENS},
    "deadline_ms": {"type": "number", "exclusiveMinimum": 0, "maximum": MAX_DEADLINE_MS},
    "control_hz": {"type": "number", "exclusiveMinimum": 0, "maximum": MAX_CONTROL_HZ},
    "left": {"type": "integer", "minimum": 1},
    "priority": {"enum": list(PRIORITIES)},
    "batch": {
        "type": "integer",
        "minimum": 1,
        "maximum": MAX_BATCH_ROWS,
        "description": "B observations in one request: each value of the observation is a list of B",
    },
    "robot": _TEXT,
    "traceparent": _TEXT,
}


def documents(metadata: Mapping[str, Any], policy: Any) -> dict[str, str]:
    """JSON by path. The observation's keys are of `policy.example_observation()`, where there is one."""
    plain = to_json(dict(metadata)).decode()
    example = policy.example_observation() if hasattr(policy, "example_observation") else {}
    return {"/v1/metadata": plain, "/v1/openapi.json": json.dumps(schema(json.loads(plain), example))}


def schema(metadata: Mapping[str, Any], example: Mapping[str, Any]) -> dict[str, Any]:
    """OpenAPI 3.1 of the two addresses, for a policy with this metadata and an observation like `example`."""
    error = {"$ref": "#/components/schemas/Error"}
    statuses = sorted({int(status) for *_, status in REFUSED} | {401, 403, 404, 408, 411, 413, 415, 431, 505})
    responses = {str(status): _body("no actions, and why", {JSON: error}) for status in statuses}
    observation, answer = ({"$ref": f"#/components/schemas/{name}"} for name in ("Observation", "Answer"))
    packed = {MSGPACK[0]: {"description": "openpi's msgpack, as over the websocket: docs/serving_protocol.md"}}
    post = {
        "summary": "The action chunk of an observation",
        "requestBody": {"required": True, **_content({JSON: observation, **packed})},
        "responses": {"200": _body("an action chunk", {JSON: answer, **packed}), **responses},
    }
    get = {"summary": "The policy's metadata", "responses": {"200": _body("metadata", {JSON: {"type": "object"}})}}
    return {
        "openapi": "3.1.0",
        "info": {"title": f"Turbo-Pi: {metadata.get('config', 'a policy')}", "version": turbopi_version()},
        "paths": {ACTIONS: {"post": post}, "/v1/metadata": {"get": get}},
        "security": [{}, {"key": []}],
        "components": {
            "securitySchemes": {"key": {"type": "http", "scheme": "bearer"}},
            "schemas": {"Observation": _observation(metadata, example), "Answer": _answer(metadata), "Error": _ERROR},
        },
    }


_ERROR = {
    "type": "object",
    "required": ["error"],
    "properties": {
        "error": {
            "type": "object",
            "required": ["kind", "text"],
            "properties": {"kind": {"enum": KINDS}, "text": _TEXT},
        }
    },
}


def _content(kinds: Mapping[str, Any]) -> dict[str, Any]:
    return {"content": {kind: {"schema": one} for kind, one in kinds.items()}}


def _body(text: str, kinds: Mapping[str, Any]) -> dict[str, Any]:
    return {"description": text, **_content(kinds)}


def _observation(metadata: Mapping[str, Any], example: Mapping[str, Any]) -> dict[str, Any]:
    properties = {key: _value(value, metadata) for key, value in example.items()}
    options = {PREFIX + key: one for key, one in OPTIONS.items()}
    return {"type": "object", "properties": {**properties, **options}}


def _value(value: Any, metadata: Mapping[str, Any]) -> dict[str, Any]:
    """The schema of an observation's entry that looks like `value`."""
    if isinstance(value, Mapping):
        return {"type": "object", "properties": {key: _value(item, metadata) for key, item in value.items()}}
    if not isinstance(value, np.ndarray):
        return dict(_TEXT) if isinstance(value, str) else {}
    if value.ndim == 3:  # uint8, or float as LeRobot's
        return {
            "type": "string",
            "pattern": "^data:image/(png|jpeg);base64,",
            "description": "an RGB image, PNG or JPEG: a data URL with its base64",
        }
    named = _named(metadata, "state")
    return _array(list(value.shape), named if value.shape[-1:] == (len(named),) else [])


def _named(metadata: Mapping[str, Any], feature: str) -> list[str]:
    """The names of a policy's "state" or "actions", with units; empty where its metadata, of any make, don't tell."""
    names = names_of(metadata, feature) or []
    return [f"{name} {metadata['features'][feature][i].get('unit', '')}".strip() for i, name in enumerate(names)]


def _size(value: Any) -> int | None:
    return value if isinstance(value, int) else None


def _array(shape: list[int | None], named: list[str]) -> dict[str, Any]:
    """Nested lists of numbers of this shape (None: any); `named` are what the last axis holds."""
    if not shape:
        return dict(_NUMBER)
    size, *rest = shape
    made: dict[str, Any] = {"type": "array", "items": _array(rest, named)}
    if size is not None:
        made |= {"minItems": size, "maxItems": size}
    if not rest and named:
        made["description"] = ", ".join(named)
    return made


def _answer(metadata: Mapping[str, Any]) -> dict[str, Any]:
    shape = [_size(metadata.get(name)) for name in ("action_horizon", "robot_action_dim")]
    actions = _array(shape, _named(metadata, "actions"))
    note = {
        "type": "object",
        "properties": {
            "kind": {"type": "string", "examples": list(NOTE_KINDS)},
            "names": {"type": "array", "items": _TEXT},
            "text": _TEXT,
        },
    }
    timing = {"type": "object", "additionalProperties": _NUMBER, "description": "milliseconds; batch: observations"}
    return {
        "type": "object",
        "required": ["server_timing"],
        "properties": {
            "actions": {**actions, "description": "[action horizon, action dimension]; [B, …] of a batch"},
            "server_timing": timing,
            "policy_timing": timing,
            "subtask": _TEXT,
            "text": _TEXT,
            NOTES: {"type": "array", "items": note},
        },
    }
