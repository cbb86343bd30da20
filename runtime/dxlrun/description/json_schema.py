"""JSON Schema of robot, motion and motor files, for completion and checks in an editor.

Pydantic's schema of the models is adapted to the text of a file: `${name}` wherever a scalar is allowed
(robot files only), numbers with grouped digits (1_000_000 is text in YAML 1.2), and the parameters of each
controller and sensor type among the keys of its entry. Required keys are in a part of their own, because a
file with includes need not have them itself. Checks that need the whole file (claims, reach, time) are left
to `dxlrun check`.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cache
from itertools import pairwise
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core.core_schema import ModelSchema

from dxlrun.description.arguments import Argument
from dxlrun.description.document import plain_value
from dxlrun.description.including import KEY as INCLUDE
from dxlrun.description.including import MOST_FILES
from dxlrun.description.joints.groups import DEFAULTS, GROUPS
from dxlrun.description.joints.joint_forms import joint_conditions
from dxlrun.description.joints.motor_file import MotorForm
from dxlrun.description.motion import MotionForm
from dxlrun.description.robot import pose_stages, robot_form

Schema = dict[str, Any]  # A JSON Schema. Its values can be any JSON, so no type narrower than Any is correct.

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_ARGUMENT: Schema = {
    "type": "string",
    "pattern": r"\$\{\s*[A-Za-z_][A-Za-z0-9_]*\s*\}",
    "description": "Value of an argument.",
}
_OF_FILE: Schema = {
    "type": "string",
    "pattern": r"^\./[A-Za-z_][A-Za-z0-9_]*\.py:[A-Za-z_][A-Za-z0-9_]*$",
    "description": "Class of a Python file next to the robot file: ./wave.py:Wave.",
}
_GROUPED: Schema = {
    "type": "string",
    "pattern": r"^[-+]?[0-9]+(_[0-9]+)+$",
    "description": "Integer with its digits in groups, such as 1_000_000.",
}
_SCALARS = ("string", "integer", "number", "boolean")
_OF_MAPPINGS = ("properties", "additionalProperties", "required")
_ABOUT = ("description", "default", "examples")


Models = Mapping[str, type[BaseModel]]  # models of parameters, by controller or sensor type
Entries = Mapping[str, tuple[str, Models]]
"""For each form of plug-in entries other than controllers: its name in the singular, and its types'
models."""


def robot_schema(controllers: Models, entries: Entries) -> Schema:
    """Return the JSON Schema of robot files, with the parameters of all installed controller types."""
    robot = _robot(controllers, entries)
    lenient = _without_required(robot)
    needed = _Needs(robot).of_root()
    # joint keys may come from defaults or groups
    joints = {"properties": {"joints": needed["properties"].pop("joints")}}
    needed |= {"if": {"anyOf": [{"required": [key]} for key in (DEFAULTS, GROUPS)]}, "else": joints}
    return {**lenient, "title": "dxlrun robot file", "if": {"required": [INCLUDE]}, "else": needed}


def fragment_schema(controllers: Models, entries: Entries) -> Schema:
    """Return the JSON Schema of fragments (included files): that of robot files without required keys."""
    return {**_without_required(_robot(controllers, entries)), "title": "dxlrun fragment of a robot file"}


def motion_schema() -> Schema:
    """Return the JSON Schema of motion files."""
    return _without_arguments(MotionForm, "dxlrun motion file")


def motor_schema() -> Schema:
    """Return the JSON Schema of motor files."""
    return _without_arguments(MotorForm, "dxlrun motor file")


def _without_arguments(model: type[BaseModel], title: str) -> Schema:
    """Return the JSON Schema of a model for files that cannot use `${name}`."""
    schema = model.model_json_schema()
    shaped = _Shaper(arguments=False)
    definitions = {name: shaped.node(node) for name, node in schema.pop("$defs").items()}
    top = shaped.node(schema)
    return {"$schema": DIALECT, **top, "title": title, "$defs": definitions | shaped.used}


def _robot(controllers: Models, entries: Entries) -> Schema:
    """Return the JSON Schema of a robot file in which all keys are required as in its model."""
    schema = robot_form().model_json_schema()
    shaped = _Shaper(arguments=True)
    definitions = {name: shaped.node(node) for name, node in schema.pop("$defs").items()}
    top = shaped.node(schema)
    own = top["properties"]
    top.pop("description")
    own["joints"]["additionalProperties"] = _selected(
        joint_conditions(), own["joints"]["additionalProperties"]
    )
    if forms := [(one.form.__name__, {"required": [one.name]}) for one in pose_stages()]:
        poses = own["poses"]
        poses["additionalProperties"] = _selected(forms, poses["additionalProperties"]["oneOf"][0])
    shared = _shared({form: definitions[form]["properties"] for form, _ in joint_conditions()})
    defaults = {"type": "object", "additionalProperties": False, "properties": shared}
    defaults["description"] = "Default keys of all joints; keys of a joint or its groups have priority."
    definitions["Group"]["properties"] |= shared
    before = {"name": own.pop("name"), "arguments": _arguments(), INCLUDE: _include(), DEFAULTS: defaults}
    top["properties"] = before | own
    others = ((form, models, f"{kind}.") for form, (kind, models) in entries.items())
    for form, models, room in (("ControllerEntry", controllers, ""), *others):
        entry = definitions[form]
        entry["properties"].pop("parameters")
        for kind, model in sorted(models.items()):
            named = f"#/$defs/{room}{kind}.{{model}}"
            own = model.model_json_schema(ref_template=named, schema_generator=_DocumentedSchema)
            for name, node in own.pop("$defs", {}).items():
                definitions[f"{room}{kind}.{name}"] = shaped.node(node)
            definitions[room + kind] = _entry_of(kind, entry, shaped.node(own))
        definitions[form] = _any_entry(entry, sorted(models), room)
    return {"$schema": DIALECT, **top, "$defs": definitions | shaped.used}


def _shared(forms: Mapping[str, Schema]) -> Schema:
    """Return the keys that `joint_defaults` and groups accept: all keys of joints but `id`, `servos`."""
    found: dict[str, list[Schema]] = {}
    for properties in forms.values():
        for key, node in properties.items():
            if key not in ("id", "servos") and node not in found.setdefault(key, []):
                found[key].append(node)
    return {key: nodes[0] if len(nodes) == 1 else {"anyOf": nodes} for key, nodes in found.items() if nodes}


def _arguments() -> Schema:
    about = {key: field.description for key, field in Argument.model_fields.items()}
    return {
        "description": "Arguments for the command line (name:=value), inserted in place of ${name}.",
        "type": "object",
        "propertyNames": {"pattern": "^[A-Za-z_][A-Za-z0-9_]*$"},
        "additionalProperties": {
            "type": "object",
            "additionalProperties": False,
            "properties": {
                "default": {"type": [*_SCALARS, "null"], "description": about["default"]},
                "help": {"type": "string", "description": about["help"]},
            },
        },
    }


def _include() -> Schema:
    return {
        "description": "Files to include, relative to this file's folder; values of this file have priority.",
        "type": "array",
        "maxItems": MOST_FILES,
        "items": {"type": "string", "minLength": 1, "not": {"pattern": r"\$\{"}},
    }


def _entry_of(kind: str, entry: Schema, parameters: Schema) -> Schema:
    """Return the JSON Schema of a controller or sensor of one type: common keys and its parameters."""
    return {
        **parameters,
        "properties": {**entry["properties"], "type": {"const": kind}, **parameters.get("properties", {})},
        "required": ["type", *parameters.get("required", [])],
        "additionalProperties": parameters.get("additionalProperties", False),
    }


def _any_entry(entry: Schema, kinds: list[str], room: str) -> Schema:
    """Return the JSON Schema of a controller or sensor, which selects the parameters by `type`.

    Args:
        entry: Schema of the common keys.
        kinds: Known types.
        room: Prefix of the types' definitions, because a controller and a sensor may have the same type.
    """
    written = {
        "description": entry["properties"]["type"]["description"],
        "anyOf": [{"enum": kinds}, {"$ref": "#/$defs/argument"}] + [_OF_FILE] * (not room),
    }
    branches = [
        {
            "if": {"properties": {"type": {"const": kind}}, "required": ["type"]},
            "then": {"$ref": f"#/$defs/{room}{kind}"},
        }
        for kind in kinds
    ]
    shown = {key: value for key, value in entry.items() if key != "additionalProperties"}
    return {**shown, "properties": {**entry["properties"], "type": written}, "allOf": branches}


def _selected(conditions: Iterable[tuple[str, Schema]], any_form: Schema) -> Schema:
    """Return the JSON Schema of an entry of a section, in which its keys select one of its forms.

    Args:
        conditions: Name of each form with the JSON Schema condition that selects it.
        any_form: JSON Schema of an entry for which no condition holds.
    """
    branches: list[Schema] = []
    before: list[Schema] = []
    for form, told_by in conditions:
        branches.append({"if": _and_none_of(told_by, before), "then": {"$ref": f"#/$defs/{form}"}})
        before.append(told_by)
    branches.append({"if": {"not": {"anyOf": before}}, "then": any_form})
    return {"allOf": branches}


def _and_none_of(condition: Schema, others: list[Schema]) -> Schema:
    return {**condition, "not": {"anyOf": [*others]}} if others else condition


class _DocumentedSchema(GenerateJsonSchema):
    """Generates pydantic's JSON Schema with the docstrings of fields as descriptions."""

    def model_schema(self, schema: ModelSchema) -> Schema:
        """Return the JSON Schema of a model, with descriptions from its fields' docstrings."""
        found = super().model_schema(schema)
        for kind in schema["cls"].__mro__:
            for key, text in _docstrings(kind).items():
                if key in found.get("properties", {}):
                    found["properties"][key].setdefault("description", text)
        return found


@cache  # Finding a class in its source is slow, and each of its subclasses needs it.
def _docstrings(kind: type) -> dict[str, str]:
    """Return the docstrings below the fields of a class, by field; empty if its source is not found."""
    with suppress(OSError, TypeError, SyntaxError):
        (made,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
        return {
            field.target.id: " ".join(below.value.value.split())
            for field, below in pairwise(made.body if isinstance(made, ast.ClassDef) else [])
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
            if isinstance(below.value.value, str)
        }
    return {}


class _Shaper:
    """Converts pydantic's JSON Schema into that of a file's text; `used` are definitions it refers to."""

    def __init__(self, *, arguments: bool) -> None:
        self._arguments = arguments
        self.used: dict[str, Schema] = {}

    def node(self, node: Schema) -> Schema:
        """Convert a schema node and all nodes below it."""
        shaped = {key: value for key, value in node.items() if key != "title"}
        # pydantic requires matching keys, but `patternProperties` lets other keys pass
        if "patternProperties" in shaped:
            ((pattern, values),) = shaped.pop("patternProperties").items()
            shaped |= {"propertyNames": {"pattern": pattern}, "additionalProperties": values}
        for key in ("items", "additionalProperties"):
            if isinstance(shaped.get(key), dict):
                shaped[key] = self.node(shaped[key])
        for key in ("prefixItems", "oneOf"):
            if key in shaped:
                shaped[key] = [self.node(each) for each in shaped[key]]
        if "oneOf" in shaped and all("$ref" in arm for arm in shaped["oneOf"]):
            # The alternatives are forms of one entry. Without required keys an entry may match several of
            # them.
            return {**{key: shaped[key] for key in shaped if key != "oneOf"}, "anyOf": shaped["oneOf"]}
        if "properties" in shaped:
            shaped["properties"] = {key: self.node(each) for key, each in shaped["properties"].items()}
        if "anyOf" in shaped or shaped.get("type") in _SCALARS:
            return self._alternatives(shaped)
        return {key: value for key, value in shaped.items() if key not in ("default", "examples")}

    def _alternatives(self, shaped: Schema) -> Schema:
        """Convert a value's alternatives: add `${name}` where it may be used, and grouped digits for numbers.

        If a mapping can also be written as one value, its properties stay next to the alternatives.
        """
        about = {key: shaped.pop(key) for key in _ABOUT if key in shaped}
        given = shaped.pop("anyOf", None)
        arms: list[Schema] = []
        for inner in [shaped] if given is None else map(self.node, given):
            arms += inner["anyOf"] if set(inner) == {"anyOf"} else [inner]
        kept = {} if given is None else {key: shaped[key] for key in _OF_MAPPINGS if key in shaped}
        kinds = {arm.get("type") for arm in arms}
        if any(arm.get("type") in ("integer", "number") and "enum" not in arm for arm in arms):
            arms.append(self._use("grouped", _GROUPED))
        free = any(set(arm) <= {"type", "minLength"} and arm.get("type") == "string" for arm in arms)
        if self._arguments and kinds & set(_SCALARS) and not free:
            arms.append(self._use("argument", _ARGUMENT))
        single: list[Schema] = []
        for arm in arms:
            if arm not in single:
                single.append(arm)
        about = _readable(about, kinds, "".join(_patterns({"anyOf": arms})))
        return about | kept | (single[0] if len(single) == 1 else {"anyOf": single})

    def _use(self, name: str, definition: Schema) -> Schema:
        self.used[name] = definition
        return {"$ref": f"#/$defs/{name}"}


def _readable(about: Schema, kinds: set[str | None], pattern: str) -> Schema:
    """Write a schema's default and examples as in a file; `pattern` has the units of a quantity.

    A default of None means an absent key, and is removed.
    """
    found = dict(about)
    text = kinds <= {"string", "null"}
    scalar = kinds <= {*_SCALARS, "null"}
    default = found.pop("default", None)
    if pattern and isinstance(default, int | float) and not kinds & {"integer", "number"}:
        default = _written(default, pattern)
    if isinstance(default, str | int | float) and default != "":
        found["default"] = default
    examples = found.pop("examples", None)
    if scalar and examples:
        found["examples"] = examples if text else [plain_value(str(each)) for each in examples]
    return found


def _patterns(node: Schema) -> list[str]:
    """Return the regular expressions of quantities that a schema node accepts, without those of names."""
    arms = [one for key in ("anyOf", "oneOf") for one in node.get(key, ())]
    inner = [node["additionalProperties"]] if isinstance(node.get("additionalProperties"), dict) else []
    own = [node["pattern"]] if r"\s*$" in node.get("pattern", "") else []
    return own + [pattern for one in arms + inner for pattern in _patterns(one)]


def _written(default: float, pattern: str) -> str | None:
    """Write a number in SI units (a time in ns) as text with a unit that its regular expression accepts."""
    units = pattern.rpartition("(")[2].partition(")")[0].replace("\\", "").split("|")
    if units == ["%"]:
        return f"{default * 100:g} %"
    if "ns" not in units:
        return f"{default:g} {next((one for one in units if one.startswith('rad')), units[0])}"
    sizes = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
    unit = next(one for one, size in sizes.items() if default % size == 0)
    return f"{default / sizes[unit]:g} {unit}"


def _without_required(node: Any) -> Any:  # noqa: ANN401 (any part of a JSON document)
    """Return a schema without its `required` keys, except for those in conditions (`if`)."""
    if isinstance(node, list):
        return [_without_required(each) for each in node]
    if not isinstance(node, dict):
        return node
    return {
        key: value if key == "if" else _without_required(value)
        for key, value in node.items()
        if key != "required" or not isinstance(value, list)
    }


class _Needs:
    """Collects the required keys of a schema as another schema, to apply them under a condition."""

    def __init__(self, schema: Schema) -> None:
        self._schema = schema
        self._above: list[str] = []

    def of_root(self) -> Schema:
        """Return a schema that has only the required keys, on every level."""
        return self._of(self._schema)

    def _of(self, node: object) -> Schema:
        if not isinstance(node, dict):
            return {}
        if "$ref" in node:
            return self._behind(node["$ref"])
        arms = [arm for arm in node.get("anyOf", ()) if arm.get("type") != "null"]
        if len(arms) == 1:
            return self._of(arms[0])
        needs: Schema = {"required": node["required"]} if node.get("required") else {}
        below = {key: self._of(each) for key, each in node.get("properties", {}).items()}
        if below := {key: each for key, each in below.items() if each}:
            needs["properties"] = below
        for key in ("items", "additionalProperties"):
            if inner := self._of(node.get(key)):
                needs[key] = inner
        branches = [(each["if"], self._of(each["then"])) for each in node.get("allOf", ()) if "if" in each]
        if branches := [(condition, inner) for condition, inner in branches if inner]:
            needs["allOf"] = [{"if": condition, "then": inner} for condition, inner in branches]
        return needs

    def _behind(self, reference: str) -> Schema:
        if reference in self._above:  # a plug-in's model that contains itself
            return {}
        self._above.append(reference)
        needs = self._of(self._schema["$defs"][reference.removeprefix("#/$defs/")])
        self._above.pop()
        return needs
