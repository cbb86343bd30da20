"""The table of requests: routes, client and description follow from it, and answers are what it says."""

import re

import pytest
from jsonschema import Draft202012Validator

from dxlrun.remote.gateway import _HANDLERS
from dxlrun.remote.requests.request_table import COMMAND, REGISTER, REQUESTS


@pytest.fixture
def description(desk):
    status, found = desk.ask("GET", "/openapi.json")
    assert status == 200
    return found


def test_each_request_is_answered_and_described(description):
    assert set(_HANDLERS) == set(REQUESTS)
    assert len({(one.method, one.path) for one in REQUESTS}) == len(REQUESTS)
    described = {(method.upper(), path) for path, found in description["paths"].items() for method in found}
    assert described == {(one.method, one.path.replace(":path", "")) for one in REQUESTS}


def test_the_description_is_whole(description):
    assert description["openapi"].startswith("3.1")
    schemas = description["components"]["schemas"]
    for schema in schemas.values():
        Draft202012Validator.check_schema(schema)
    named = set(re.findall(r"#/components/schemas/(\w+)", str(description)))
    assert named == set(schemas)
    switch = description["paths"]["/switch"]["post"]
    assert switch["summary"].startswith("Activate and deactivate controllers")
    parameters = description["paths"]["/controllers/{name}/commands/{kind}"]["post"]["parameters"]
    assert [(one["name"], one["in"]) for one in parameters] == [
        ("name", "path"), ("kind", "path"), ("units", "query"), ("in", "query"), ("goal", "query"),
    ]  # fmt: skip


ASKED = [
    ("GET", "/robot", None, "/robot"),
    ("GET", "/states", None, "/states"),
    ("GET", "/frames", None, "/frames"),
    ("GET", "/log-header", None, "/log-header"),
    ("GET", "/events?after=0", None, "/events"),
    ("GET", "/topics", None, "/topics"),
    ("GET", "/goals", None, "/goals"),
    ("GET", "/joints/pan", None, "/joints/{name}"),
    ("GET", "/controllers/left/parameters", None, "/controllers/{name}/parameters"),
    ("POST", "/controllers/left/commands/go", {"positions": [0.25]}, "/controllers/{name}/commands/{kind}"),
    ("POST", "/controllers/left/set-points/go", {"positions": [1]}, "/controllers/{name}/set-points/{kind}"),
    ("POST", "/switch", {"activate": ["spare"]}, "/switch"),
    ("POST", "/switch", {"activate": ["nun"]}, "/switch"),
    ("POST", "/rate", {"rate": 40}, "/rate"),
]  # fmt: skip


@pytest.mark.parametrize("asked", ASKED, ids=[" ".join(one[:2]) for one in ASKED])
def test_body_and_answer_are_as_described(desk, description, asked):
    method, path, body, pattern = asked
    found = description["paths"][pattern][method.lower()]
    if body is not None:
        check(description, found["requestBody"], body)
    status, answer = desk.ask(method, path, b"" if body is None else body)
    check(description, found["responses"]["2XX" if status < 300 else "default"], answer)


def check(description, content, value):
    (schema,) = (one["schema"] for one in content["content"].values())
    Draft202012Validator({**schema, "components": description["components"]}).validate(value)


def test_names_in_a_path_cannot_leave_their_places():
    assert (
        COMMAND.target("a/../b?", r"\g<0>{kind}")
        == "/controllers/a%2F..%2Fb%3F/commands/%5Cg%3C0%3E%7Bkind%7D"
    )
    assert REGISTER.target("hip/1", "{item}") == "/joints/hip%2F1/registers/%7Bitem%7D"
