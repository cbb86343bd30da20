"""Groups: copies `joint_defaults` and keys of `groups` into joints, and replaces group names by joints.

`joint_defaults` has keys for every joint, a group has keys for its joints; a joint's own keys take
precedence. After that a group is only a name for its joints, which replace it wherever a file names joints.
All values keep the places in the file where they were written.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeVar

from msgspec.structs import replace

from dxlrun.description.document import KeyPath, Marks, PlainDocument
from dxlrun.description.form_problems import format_value, path_text
from dxlrun.description.including import merged
from dxlrun.description.joints.joint_forms import keys_of_servos
from dxlrun.errors import Problem, suggestion
from dxlrun.features import installed_features, stages
from dxlrun.features.feature import Section

DEFAULTS, GROUPS, ALL = "joint_defaults", "groups", "all"
NAMING = ("joints", "pose", "torque")
"""Keys whose list or mapping names joints or groups; so does each entry of `poses`."""

Groups = Mapping[str, tuple[str, ...]]  # joints of each group, by its name
NO_GROUPS: Groups = {}
Moves = dict[KeyPath, list[KeyPath]]
"""For each moved value of a document, its old path and the paths to which it was copied."""
_Value = TypeVar("_Value")


def with_groups(grown: PlainDocument) -> PlainDocument:
    """Return a robot file's document in which each joint has its keys from `joint_defaults` and groups.

    Groups keep only their joints, and their names elsewhere are replaced by the joints.
    """
    data = grown.data
    if DEFAULTS not in data and GROUPS not in data:
        return grown
    grown = replace(grown, problems=(*grown.problems, *_mistakes(grown)))
    if not isinstance(data.get("joints"), dict):
        # The missing joints are the only mistake; layers would make joints, and groups would be empty.
        return _without_defaults(grown, NO_GROUPS)
    groups = _groups(data)
    # Lowest precedence first: defaults, then groups, then the joints' own keys.
    sources: list[tuple[KeyPath, tuple[str, ...]]] = [((DEFAULTS,), tuple(_mapping(data.get("joints"))))]
    sources += [((GROUPS, name), joints) for name, joints in groups.items()]
    of_servos, without_servo = keys_of_servos(), _without_servo(data, groups)
    layers = [_layer(grown, source, joints, without_servo, of_servos) for source, joints in sources]
    grown = replace(grown, problems=(*grown.problems, *_disagreements(grown, groups, layers[1:])))
    return put_in(merged([*layers, _without_defaults(grown, groups)]), groups)


def put_in(grown: PlainDocument, groups: Groups) -> PlainDocument:
    """Replace names of groups in a document by their joints, in lists and in keys of mappings.

    In a mapping, a joint that is named directly keeps its own value; a joint in two groups is a problem.
    """
    places = _Places(grown.marks, groups)
    data = places.value(grown.data, ())
    assert isinstance(data, dict)  # noqa: S101 (the top of a document is a mapping)
    return replace(moved(grown, places.moves), data=data, problems=(*grown.problems, *places.problems))


def without_groups(data: dict[str, object], groups: Groups) -> dict[str, object]:
    """Replace names of groups by their joints in data without a file, such as a client's request."""
    return put_in(PlainDocument(data, Marks("", {}, {}), (), frozenset()), groups).data


class _Places:
    """Replaces names of groups in a document by joints, and notes which values moved where."""

    def __init__(self, marks: Marks, groups: Groups) -> None:
        self._marks = marks
        self._groups = groups
        self.moves: Moves = {}
        self.problems: list[Problem] = []

    def value(self, value: object, path: KeyPath) -> object:
        """Return the value at a path with joints in place of groups."""
        naming = bool(path) and (path[-1] in NAMING or path[-2:-1] == ("poses",))
        if isinstance(value, dict):
            if naming and not self._groups.keys().isdisjoint(value):
                return self._mapping(value, path)
            return {key: self.value(item, (*path, key)) for key, item in value.items()}
        if isinstance(value, list):
            if naming and any(isinstance(item, str) and item in self._groups for item in value):
                return self._list(value, path)
            return [self.value(item, (*path, index)) for index, item in enumerate(value)]
        return value

    def _list(self, value: list[object], path: KeyPath) -> list[object]:
        result: list[object] = []
        for index, item in enumerate(value):
            names = self._groups.get(item, (item,)) if isinstance(item, str) else (item,)
            self.moves[*path, index] = [(*path, len(result) + place) for place in range(len(names))]
            result += names
        return result

    def _mapping(self, value: dict[str, object], path: KeyPath) -> dict[str, object]:
        result: dict[str, object] = {}
        origin: dict[str, str] = {}
        for key, item in value.items():
            names = [one for one in self._groups.get(key, ()) if one not in value]
            names += [key] * (key not in self._groups)
            self.moves[*path, key] = [(*path, one) for one in names]
            for one in names:
                if one in result:
                    what = f"{path_text(path)} sets {one} twice, in groups {origin[one]} and {key}"
                    fix = f"add a value for {one}; it has priority over groups"
                    self.problems.append(Problem(self._marks.key(*path, key), what, fix))
                result[one], origin[one] = item, key
        return result


def _groups(data: Mapping[str, object]) -> dict[str, tuple[str, ...]]:
    """Return the joints of each group, with those of groups in it; malformed entries are skipped.

    So is a group without a known joint: a list that names it must not become empty.
    """
    joints, entries = _mapping(data.get("joints")), _named(data)
    return {
        name: members
        for name in entries
        if (members := tuple(dict.fromkeys(one for one in _members(entries, name) if one in joints)))
    }


def _named(data: Mapping[str, object]) -> dict[str, object]:
    """Return the entries of `groups` without those whose name is that of a joint, or `all`."""
    joints = _mapping(data.get("joints"))
    return {name: one for name, one in _mapping(data.get(GROUPS)).items() if name not in (*joints, ALL)}


def _members(entries: Mapping[str, object], name: str, above: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield the names in a group and, instead of groups in it, their names; a cycle ends where it closes."""
    for _, one in _written(entries, name):
        if one not in entries:
            yield one
        elif one not in (*above, name):
            yield from _members(entries, one, (*above, name))


def _written(entries: Mapping[str, object], name: str) -> Iterator[tuple[int, str]]:
    """Yield the names in a group's own list `joints`, each with its index."""
    names = _mapping(entries.get(name)).get("joints")
    for index, one in enumerate(names if isinstance(names, list) else ()):
        if isinstance(one, str):
            yield index, one


def _mapping(value: object) -> dict[str, object]:
    return value if isinstance(value, dict) else {}


def _mistakes(grown: PlainDocument) -> Iterator[Problem]:
    """Yield problems in `joint_defaults` and `groups`: unknown joints, ambiguous names, cycles."""
    joints, entries = grown.data.get("joints"), _named(grown.data)
    if not isinstance(defaults := grown.data.get(DEFAULTS, {}), dict):
        what = f"{DEFAULTS} is {format_value(defaults)}, but must be a mapping"
        yield Problem(grown.marks.value(DEFAULTS), what, f"write keys of a joint below {DEFAULTS}")
    for name, entry in _mapping(_mapping(grown.data.get("policies")).get(GROUPS)).items():
        if name in entries and "joints" in _mapping(entry):
            what = f"group {name} already has joints in the section groups"
            yield Problem(grown.marks.key("policies", GROUPS, name, "joints"), what, "remove joints")
    for name in _mapping(grown.data.get(GROUPS)):
        if name not in entries:
            means = "every joint" if name == ALL else "a joint"
            what = f"the name {name} of a group already means {means}"
            yield Problem(grown.marks.key(GROUPS, name), what, "rename the group")
    for name in entries:
        for index, one in _written(entries, name):
            mark = grown.marks.value(GROUPS, name, "joints", index)
            if isinstance(joints, dict) and one not in joints and one not in entries:
                what = f"joint {one} of group {name} is not defined"
                others = (each for each in entries if each != name)
                yield Problem(mark, what, suggestion(one, (*joints, *others)))
            elif circle := _circle(entries, (name, one)):
                what = f"the group {name} contains itself ({' -> '.join(circle)})"
                yield Problem(mark, what, f"remove {one} from {name}")


def _circle(entries: Mapping[str, object], way: tuple[str, ...]) -> tuple[str, ...]:
    """Return a cycle of groups that contain each other, only from its first group in the file; or ()."""
    first, last = way[0], way[-1]
    if last == first:
        return way if first == min(way, key=list(entries).index) else ()
    if last not in entries or last in way[:-1]:
        return ()
    below = (_circle(entries, (*way, one)) for _, one in _written(entries, last))
    return next((circle for circle in below if circle), ())


def _without_servo(data: Mapping[str, object], groups: Groups) -> frozenset[str]:
    """Return the joints that sections of features move, which have no servo of their own."""
    sections = (section for _, section in stages(Section, installed_features()))
    named = (one for each in sections for one in each.moved_joints(data.get(each.name)))
    return frozenset(joint for one in named for joint in groups.get(one, (one,)))


def _layer(
    grown: PlainDocument,
    source: KeyPath,
    joints: tuple[str, ...],
    without_servo: frozenset[str],
    of_servos: frozenset[str],
) -> PlainDocument:
    """Return a document that has, for each of these joints, the keys of `joint_defaults` or of a group.

    Joints in `without_servo` do not get the keys in `of_servos`.
    """
    at: object = grown.data
    for step in source:
        at = _mapping(at).get(str(step))
    given = {key: value for key, value in _mapping(at).items() if key != "joints"}
    keys = {
        joint: [key for key in given if joint not in without_servo or key not in of_servos]
        for joint in joints
    }
    moves: Moves = {
        (*source, key): [("joints", joint, key) for joint in joints if key in keys[joint]] for key in given
    }
    data: dict[str, object] = {
        "joints": {joint: {key: given[key] for key in keys[joint]} for joint in joints}
    }
    return replace(moved(grown, moves, others=False), data=data, problems=())


def _disagreements(grown: PlainDocument, groups: Groups, layers: list[PlainDocument]) -> Iterator[Problem]:
    """Yield a problem for each joint that gets different values of a key from two groups."""
    own = {path for path, _ in _leaves(_mapping(grown.data.get("joints")))}
    before: dict[KeyPath, tuple[str, object]] = {}
    for name, layer in zip(groups, layers, strict=True):
        for path, value in _leaves(_mapping(layer.data["joints"])):
            other, first = before.setdefault(path, (name, value))
            if first != value and path not in own:
                joint, key = path[0], path_text(path[1:])
                what = (
                    f"groups {name} and {other} set {key} of {joint} to {format_value(value)} "
                    f"and {format_value(first)}"
                )
                mark = layer.marks.value("joints", *path)
                yield Problem(mark, what, f"write {key} at {joint}, or in one group only")


def _leaves(value: dict[str, object], path: KeyPath = ()) -> Iterator[tuple[KeyPath, object]]:
    for key, item in value.items():
        if isinstance(item, dict):
            yield from _leaves(item, (*path, key))
        else:
            yield (*path, key), item


def _without_defaults(grown: PlainDocument, groups: Groups) -> PlainDocument:
    """Return a document without `joint_defaults`, and with groups that have no key but `joints`."""
    data = {key: value for key, value in grown.data.items() if key != DEFAULTS}
    policies = _mapping(data.get("policies"))
    if any(name in groups for name in _mapping(policies.get(GROUPS))):
        own = {
            name: {"joints": [*groups.get(name, ())], **entry} if isinstance(entry, dict) else entry
            for name, entry in _mapping(policies[GROUPS]).items()
        }
        data["policies"] = {**policies, GROUPS: own}
    if isinstance(entries := data.get(GROUPS), dict):
        bare: dict[str, object] = {}
        for name, entry in entries.items():
            names = {"joints": [*groups.get(name, ())] or _mapping(entry).get("joints")}
            bare[name] = entry if not isinstance(entry, dict) else names if "joints" in entry else {}
        data[GROUPS] = bare
    return replace(grown, data=data)


def moved(grown: PlainDocument, moves: Moves, *, others: bool = True) -> PlainDocument:
    """Return a document whose places follow its moved values; `others`: keep the places of the others."""

    def placed(table: Mapping[KeyPath, _Value]) -> dict[KeyPath, _Value]:
        found: dict[KeyPath, _Value] = {}
        for path, value in table.items():
            at = next((path[:end] for end in range(1, len(path) + 1) if path[:end] in moves), None)
            if at is not None:
                found.update({(*to, *path[len(at) :]): value for to in moves[at]})
            elif others:
                found[path] = value
        return found

    marks = grown.marks
    unknown = frozenset(placed(dict.fromkeys(grown.unknown)))
    return replace(
        grown,
        marks=Marks(marks.file, placed(marks.values), placed(marks.keys), placed(marks.origins)),
        unknown=unknown,
    )
