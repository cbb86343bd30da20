"""Omitted joints: removes joints whose servos are not installed from a file, with all that needs them.

A robot file is reduced once, after its groups are known and before it is validated, so that no later stage
knows these joints: their servos get no packet. A motion file is reduced in the same way.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TypeVar

import msgspec
from msgspec.structs import replace

from dxlrun.description.arguments import COMMAND_LINE
from dxlrun.description.document import KeyPath, Marks, PlainDocument, refusal
from dxlrun.description.joints.groups import NAMING
from dxlrun.errors import Problem
from dxlrun.features import installed_features, stages
from dxlrun.features.feature import Section

INSTALLED = "installed"
_LISTS = (*NAMING, "left", "right", "wrap")
"""Keys whose list names joints, in controllers as well; joints that are omitted are removed from it."""
_SINGLE = ("joint", "leader")
"""Keys that name one joint, without which the mapping that has the key cannot exist."""
_RESCUERS = ("fallback", "activate")
"""Keys of a controller that name those that take over from it, or protect the robot at its command."""
_OTHERS = ("into", *_RESCUERS)
"""Keys of a controller whose list names controllers."""
_CONTROLLERS, _POLICIES, _POSES, _BUSES = "controllers", "policies", "poses", "buses"
_Value = TypeVar("_Value")


class Omission(msgspec.Struct, frozen=True):
    """A robot file's document without the joints that are omitted, and what this changed."""

    document: PlainDocument
    names: tuple[str, ...] = ()
    """Joints that are omitted, then groups that have no other joint."""
    remarks: tuple[Problem, ...] = ()
    """A warning that names the joints, what is omitted with them, and what is without them."""
    uneven: tuple[KeyPath, ...] = ()
    """Lists of controllers that may have one value for each joint, also for those omitted."""
    poses: tuple[str, ...] = ()
    """Poses that are omitted because all their joints are."""


def omit_joints(grown: PlainDocument, without: Sequence[str]) -> Omission:
    """Remove all joints with `installed: false`, and those that the command line omits.

    Args:
        grown: Document of a robot file whose groups have been replaced by joints.
        without: Names of joints and groups, from `--without`.

    Raises:
        InputError: A name is not that of a joint or a group, or no joint is left.
    """
    joints, groups = _mapping(grown.data.get("joints")), _mapping(grown.data.get("groups"))
    members = {name: _mapping(group).get("joints") for name, group in groups.items()}
    _refuse_unknown(without, (*joints, *groups))
    named = {joint for name in without for joint in _list(members.get(name, [name]))}
    absent = {name for name, joint in joints.items() if _mapping(joint).get(INSTALLED) is False}
    out = tuple(name for name in joints if name in named | absent)
    if not out:
        return Omission(grown)
    in_file = next((name for name in out if name in absent and name not in named), None)
    mark = COMMAND_LINE if in_file is None else grown.marks.value("joints", in_file, INSTALLED)
    if len(out) == len(joints):
        raise refusal(mark, "all joints are omitted", "omit fewer joints")
    remover = _Remover(out, joints)
    reduced = remover.reduced(grown)
    problems = (*grown.problems, *_parted(grown, out), *_missed(grown, reduced))
    it, what = "it" if len(out) == 1 else "them", _are_omitted(out)
    if remover.gone:
        what += f", and with {it} {_by_kind(remover.gone)}"
    if remover.changed:
        what += f"; {_by_kind(remover.changed)} {'is' if len(remover.changed) == 1 else 'are'} without {it}"
    fix = "omit --without" if in_file is None else f"remove {INSTALLED}: false"
    remark = Problem(mark, what, f"{fix} to run with {it}", severity="warning")
    left = _mapping(reduced.data.get("groups"))
    return Omission(
        replace(reduced, problems=problems),
        (*out, *(name for name in groups if name not in left)),
        (remark,),
        tuple(at for at in remover.uneven if str(at[1]) in _mapping(reduced.data.get(_CONTROLLERS))),
        tuple(sorted(remover.poses)),
    )


def without_joints(grown: PlainDocument, omitted: Collection[str]) -> tuple[PlainDocument, tuple[str, ...]]:
    """Remove joints and groups from a motion file, with the points and parts that have no other joint.

    Returns the document, and the joints and groups that it had.

    Raises:
        InputError: The motion moves no other joint.
    """
    named = {str(step) for path in grown.marks.keys for step in path[-1:]}
    if not (without := tuple(name for name in omitted if name in named)):
        return grown, ()
    reduced = _Remover(omitted, ()).reduced(grown)
    if grown.data.get("motions") and not reduced.data.get("motions"):
        what = f"the motion moves only joints that this run omits: {', '.join(without)}"
        raise refusal(grown.marks.key("motions"), what, "play another motion")
    return reduced, without


class _Remover:
    """Removes joints from a document, and notes where the other values are afterwards."""

    def __init__(self, out: Collection[str], joints: Collection[str]) -> None:
        self._out, self._joints = frozenset(out), joints
        self._places: dict[KeyPath, KeyPath] = {}
        self.poses: frozenset[str] = frozenset()
        self.gone: list[str] = []
        """Entries of sections that are omitted with the joints, such as `controller gripper`."""
        self.changed: list[str] = []
        """Entries of sections that continue without the joints, such as `controller arm`."""
        self.uneven: list[KeyPath] = []
        """Lists of controllers that are as long as their list `joints` was, so they may be in its order."""

    def reduced(self, grown: PlainDocument) -> PlainDocument:
        """Return the document without the joints."""
        self.poses = frozenset(
            name
            for name, pose in _mapping(grown.data.get(_POSES)).items()
            if _mapping(pose) and self._out.issuperset(_mapping(pose))
        )
        data = _mapping(self._value(grown.data, (), ()))
        self._drop_lowers(data)
        self._drop_buses(grown.data, data)
        marks = grown.marks
        return replace(
            grown,
            data=data,
            marks=Marks(
                marks.file, self._moved(marks.values), self._moved(marks.keys), self._moved(marks.origins)
            ),
            unknown=frozenset(self._moved(dict.fromkeys(grown.unknown))),
        )

    def _moved(self, table: Mapping[KeyPath, _Value]) -> dict[KeyPath, _Value]:
        return {self._places[path]: value for path, value in table.items() if path in self._places}

    def _value(self, value: object, path: KeyPath, place: KeyPath) -> object:
        """Return the value at a path without the joints; None if it cannot exist without them.

        `place` is the new path of the value, because items before it in a list may be removed.
        """
        self._places[path] = place
        if isinstance(value, dict):
            return self._mapping(value, path, place)
        return self._items(value, path, place) if isinstance(value, list) else value

    def _mapping(self, value: dict[str, object], path: KeyPath, place: KeyPath) -> dict[str, object] | None:
        if any(isinstance(name := value.get(key), str) and name in self._out for key in _SINGLE):
            return None
        of_entries = len(path) == 1 or path == (_POLICIES, "groups")
        by_joint = self._is_by_joint(value, path)
        if path[:1] == (_CONTROLLERS,) and self._out.intersection(joints := _list(value.get("joints"))):
            self.uneven += [
                (*place, key)
                for key, item in value.items()
                if isinstance(item, list) and len(item) == len(joints) and key not in (*_LISTS, *_OTHERS)
            ]
        result: dict[str, object] = {}
        for key, item in value.items():
            if by_joint and key in self._out:
                continue
            kept = self._value(item, (*path, key), (*place, key))
            if _is_emptied(item, kept):
                if path[:1] == (_POLICIES,) and isinstance(kept, list) and key != "joints":
                    kept = "limp"
                elif (
                    key == "joints" or path == (_POSES,) or (isinstance(kept, list) and "joints" not in value)
                ):
                    kept = None
            if kept is None and item is not None:
                if not of_entries:
                    return None
                self.gone.append(_entry(path, key))
            else:
                result[key] = kept
                if of_entries and not by_joint and kept != item and (*path, key) != (_POLICIES, "groups"):
                    self.changed.append(_entry(path, key))
        return result

    def _is_by_joint(self, value: Mapping[str, object], path: KeyPath) -> bool:
        """Return True if a mapping has joints as keys: `pose: {elbow: 10 deg}`, or `p: {elbow: 3.0}`."""
        if path[-1:] in {(key,) for key in NAMING} or (len(path) == 2 and path[0] == _POSES):
            return True
        plain = path[-1:] == ("registers",) or not any(
            isinstance(item, dict | list) for item in value.values()
        )
        return plain and len(path) > 2 and all(key in self._joints for key in value)

    def _items(self, value: list[object], path: KeyPath, place: KeyPath) -> list[object]:
        result: list[object] = []
        for index, item in enumerate(value):
            if isinstance(item, str) and item in self._out and path[-1] in _LISTS:
                continue
            if path[:1] == (_POLICIES,) and self.poses.intersection(_list(_mapping(item).get("pose"))):
                continue
            kept = self._value(item, (*path, index), (*place, len(result)))
            if kept is not None or item is None:
                result.append(kept)
        return result

    def _drop_lowers(self, data: dict[str, object]) -> None:
        """Remove dropped controllers from `into` of the others, and drop those that command no other."""
        controllers = _mapping(data.get(_CONTROLLERS))
        gone = [name.partition(" ")[2] for name in self.gone if name.startswith("controller ")]
        for lower in gone:  # grows
            for upper, entry in [*controllers.items()]:
                into = _list(_mapping(entry).get("into"))
                if lower not in into:
                    continue
                left = _mapping(entry)["into"] = [name for name in into if name != lower]
                if not left:
                    del controllers[upper]
                    gone.append(upper)
                    self.gone.append(f"controller {upper}")
        self.changed = [name for name in self.changed if name not in self.gone]

    def _drop_buses(self, before: Mapping[str, object], data: dict[str, object]) -> None:
        """Drop each bus that only removed servos had, so that its port is not opened."""
        idle = {*_named_buses(before)} - {*_named_buses(data)}
        buses = _mapping(data.get(_BUSES))
        for name in [name for name in buses if name in idle]:
            del buses[name]
            self.gone.append(f"bus {name}")


def _refuse_unknown(without: Sequence[str], known: Sequence[str]) -> None:
    if wrong := [name for name in without if name not in known]:
        what = f"--without {', '.join(wrong)}: the robot has no such joint or group"
        raise refusal(COMMAND_LINE, what, f"it has {', '.join(known)}")


def _parted(grown: PlainDocument, out: Sequence[str]) -> Iterator[Problem]:
    """Yield a problem for each entry, such as a transmission, of which only some joints are omitted."""
    for _, section in stages(Section, installed_features()):
        for name, entry in _mapping(grown.data.get(section.name)).items():
            moved = [*section.moved_joints({name: entry})]
            rest = [joint for joint in moved if joint not in out]
            if rest and len(rest) < len(moved):
                gone = [joint for joint in moved if joint in out]
                what = f"{_are_omitted(gone)}, but {name} moves {_listed(rest)} by the same servos"
                yield Problem(grown.marks.key(section.name, name), what, f"omit {_listed(rest)}, too")


def _missed(grown: PlainDocument, reduced: PlainDocument) -> Iterator[Problem]:
    """Yield a problem for each controller of which another one, which continues, expects safety."""
    before, after = (_mapping(each.data.get(_CONTROLLERS)) for each in (grown, reduced))
    for name, entry in after.items():
        for key in _RESCUERS:
            for other in _list(_mapping(entry).get(key)):
                if other in before and other not in after:
                    mark = grown.marks.value(_CONTROLLERS, name, key)
                    what = f"{key} of {name} names {other}, which is omitted with its joints"
                    yield Problem(mark, what, "name another controller")


def _is_emptied(item: object, kept: object) -> bool:
    return isinstance(kept, dict | list) and bool(item) and not kept


def _entry(path: KeyPath, key: str) -> str:
    """Return the name of an entry of a section for messages: `controller arm`."""
    if path[0] == _POLICIES:
        return f"policies of {key}" if path[1:] else f"policy {key}"
    return f"{str(path[0]).removesuffix('s')} {key}"


def _named_buses(value: object) -> Iterator[str]:
    """Yield the value of each key `bus` in a document."""
    if isinstance(value, dict):
        for key, item in value.items():
            if key == "bus" and isinstance(item, str):
                yield item
            yield from _named_buses(item)
    elif isinstance(value, list):
        for item in value:
            yield from _named_buses(item)


def _are_omitted(joints: Sequence[str]) -> str:
    return f"{_listed(joints)} {'is' if len(joints) == 1 else 'are'} omitted"


def _by_kind(entries: Sequence[str]) -> str:
    """Return entries of sections as text: `controllers arm and hand, pose home`."""
    kinds: dict[str, list[str]] = {}
    for kind, _, name in (entry.rpartition(" ") for entry in entries):
        kinds.setdefault(kind, []).append(name)
    several = {"bus": "buses", "policy": "policies", "policies of": "policies of"}
    return _listed(
        [
            f"{kind if len(names) == 1 else several.get(kind, f'{kind}s')} {_listed(names)}"
            for kind, names in kinds.items()
        ]
    )


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else names[0]


def _mapping(value: object) -> dict[str, object]:
    return value if isinstance(value, dict) else {}


def _list(value: object) -> list[str]:
    """Return the texts in a list, or a single text as a list."""
    items = [value] if isinstance(value, str) else value if isinstance(value, list) else []
    return [item for item in items if isinstance(item, str)]
