"""Controller graph: which controller reads, claims and commands what, and the mistakes in that.

It is used for the controllers of a robot file and for a controller that is loaded into a run. Each mistake
has its path in the file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Literal, TypeAlias

import msgspec

from dxlrun.control.controllers.claims import Conflict, ControllerSnapshot, conflicts, conflicts_text
from dxlrun.control.controllers.update_order import above, below, circles, drawn, update_order
from dxlrun.description.document import KeyPath
from dxlrun.errors import suggestion
from dxlrun.output.graph import Edge, Graph, Node, listed
from dxlrun.plan.loop_plan import ControllerPlan, SourcePlan

STATES = ("position", "velocity", "effort", "temperature", "voltage", "age")
"""State interfaces that controllers can read of every joint; `age` is the age of the state, s."""
_LONGEST = 6  # names of joints in one message


class GraphEdge(msgspec.Struct, frozen=True):
    """A data flow from `source` to `target`, names of controllers, joints or sources."""

    kind: Literal["command", "reference", "read"]
    """`command`: controller to joint; `reference`: controller to controller; `read`: a source to its
    reader."""
    source: str
    target: str
    joint: str
    interfaces: tuple[str, ...]


class Mistake(msgspec.Struct, frozen=True):
    """A mistake of a controller: path of the key in the robot file, problem, and fix."""

    at: KeyPath
    what: str
    fix: str


Check: TypeAlias = Callable[[ControllerPlan], Iterable[Mistake]]


class ControllerGraph:
    """All controllers of a robot and the joints and sources that they use; finds mistakes, draws the graph.

    Args:
        joints: All joints of the robot.
        controllers: All controllers, in the order of the file.
        sources: Devices and sensors.
        incomplete: Controllers and sources with mistakes, whose joints and interfaces are not known.
    """

    def __init__(
        self,
        joints: Sequence[str],
        controllers: Sequence[ControllerPlan],
        sources: Sequence[SourcePlan] = (),
        incomplete: frozenset[str] = frozenset(),
    ) -> None:
        self.joints = joints
        self.controllers = controllers
        self.sources = sources
        self._incomplete = incomplete
        self._named = {plan.name: plan for plan in controllers}

    @property
    def order(self) -> tuple[str, ...]:
        """Names of all controllers in the order in which a cycle updates them."""
        return update_order(self.controllers)

    @property
    def edges(self) -> tuple[GraphEdge, ...]:
        """All data flows of a graph without mistakes, grouped by controller, in file order."""
        return tuple(edge for plan in self.controllers for edge in self._edges_of(plan))

    def find_mistakes(self) -> Iterator[Mistake]:
        """Yield every mistake of the graph: unknown names, conflicting claims, circles, rates, fallbacks."""
        checks: Sequence[Check] = (
            self._targets,
            self._exports,
            self._activity,
            self._rates,
            self._reads,
            self._source_commands,
            self._takeovers,
            self._needed_together,
            self._fallback,
        )
        for plan in self.controllers:
            for check in checks:
                yield from check(plan)
        yield from self._circles()
        yield from self._active_claims()

    def warnings(self) -> Iterator[Mistake]:
        """Yield a warning for each interface in `reads` by which a controller gets its own values back."""
        for plan in self.controllers:
            for index, interface in enumerate(plan.reads):
                if found := self._read_back(plan, interface):
                    what, fix = found
                    at = (*_path(plan.name), "reads", index)
                    yield Mistake(at, f"{plan.name} reads {interface}, {what}", fix)

    def _read_back(self, plan: ControllerPlan, interface: str) -> tuple[str, str] | None:
        """Return problem and fix if a controller reads a value that it produces itself; else None."""
        source, _, name = interface.rpartition("/")
        owner, _, joint = source.partition("/")
        if source == plan.name and name in plan.provides:
            return "its own state of the previous cycle", "keep the value in the controller"
        if owner == plan.name and joint:
            return "its own reference", "remove it"
        commanded = name in plan.command and joint in plan.joints
        if commanded and owner in [lower.name for lower in self._exporters(plan, joint)]:
            return (
                "its own command of the previous cycle",
                f"read the state {joint}/{name}, or remove this entry",
            )
        return None

    def drawing(self, title: str, rate: float) -> Graph:
        """Return the graph as a picture with boxes for sources, controllers and joints; `rate` is in Hz.

        Joints with the same controllers are one node. Reads of a controller's own joints are drawn only for
        controllers without commands.
        """
        commanding: dict[str, list[str]] = {}
        reads: dict[tuple[str, str, str], list[str]] = {}
        """Joints by reader, owner and interface; the owner is the exporting controller, empty for joint
        states."""
        for edge in self.edges:
            if edge.kind == "command":
                commanding.setdefault(edge.joint, []).append(edge.source)
            elif edge.kind == "read":
                owner = "" if edge.source == edge.joint else f"{edge.source}/"
                reads.setdefault((edge.target, owner, edge.interfaces[0]), []).append(edge.joint)
        for plan in self.controllers:
            if plan.joints and not (plan.command or plan.reference):
                reads[plan.name, "", "states"] = list(plan.joints)
        sources: dict[tuple[str, str, tuple[str, ...]], list[str]] = {}
        for (reader, owner, interface), joints in reads.items():
            sources.setdefault((reader, owner, tuple(joints)), []).append(interface)
        nodes: dict[str, Node] = {}
        edges: dict[Edge, None] = {}
        for (reader, owner, read), interfaces in sources.items():
            out = " + ".join(interfaces)
            name = f"{out} of {owner}{' '.join(read)}"
            lines = tuple(owner + line for line in listed(self._together(read)))
            nodes[name] = Node(name, "source", lines, out)
            edges[Edge(name, reader)] = None
        for plan in self.controllers:
            about = f"{plan.type}, {rate / max(plan.every, 1):g} Hz"
            out = " + ".join(plan.command)
            lines = (plan.name, *([f"fallback: {plan.fallback}"] if plan.fallback else []))
            nodes[plan.name] = Node(plan.name, "controller", lines, out, about, plan.active)
        groups: dict[tuple[str, ...], list[str]] = {}
        for joint in self.joints:
            if joint in commanding:
                groups.setdefault(tuple(commanding[joint]), []).append(joint)
        for controllers, joints in groups.items():
            name = f"joints {' '.join(joints)}"
            nodes[name] = Node(name, "joints", listed(self._together(joints)))
            edges |= dict.fromkeys(Edge(controller, name) for controller in controllers)
        edges |= dict.fromkeys(Edge(one.source, one.target) for one in self.edges if one.kind == "reference")
        return Graph(title, tuple(nodes.values()), tuple(edges))

    def _together(self, joints: Sequence[str]) -> Sequence[str]:
        """Return the names of joints for a box, or one text `all N joints` if they are all of the robot."""
        return [f"all {len(joints)} joints"] if 2 < len(joints) == len(self.joints) else joints

    # Edges

    @cached_property
    def _readable(self) -> Mapping[str, tuple[str, ...]]:
        """Readable interfaces by source: `JOINT`, `CONTROLLER/JOINT`, or device, sensor, controller."""
        states = dict.fromkeys(self.joints, STATES)
        references = {
            f"{plan.name}/{joint}": plan.reference
            for plan in self.controllers
            if plan.reference
            for joint in plan.joints
        }
        others = {one.name: (*one.states, "age") for one in self.sources}
        provided = {plan.name: (*plan.provides, "age") for plan in self.controllers if plan.provides}
        return {**states, **references, **others, **provided}

    def _edges_of(self, plan: ControllerPlan) -> Iterator[GraphEdge]:
        """Yield the data flows of one controller: first those that it reads, then those that it commands."""
        for interface in plan.reads:
            source, _, name = interface.rpartition("/")
            owner, _, joint = source.rpartition("/")
            yield GraphEdge("read", owner or joint, plan.name, joint, (name,))
        for joint in plan.joints if plan.command else ():
            if not plan.into:
                yield GraphEdge("command", plan.name, joint, joint, plan.command)
            for lower in self._exporters(plan, joint):
                yield GraphEdge("reference", plan.name, lower.name, joint, plan.command)

    def _lowers(self, plan: ControllerPlan) -> list[ControllerPlan]:
        """Return the controllers that a controller commands (`into`), without unknown names and itself."""
        return [
            self._named[name]
            for name in dict.fromkeys(plan.into)
            if name in self._named and name != plan.name
        ]

    def _exporters(self, plan: ControllerPlan, joint: str) -> list[ControllerPlan]:
        """Return the controllers in `into` that accept all commanded interfaces as references for a joint."""
        return [
            lower
            for lower in self._lowers(plan)
            if joint in lower.joints and set(plan.command) <= set(lower.reference)
        ]

    # Rules

    def _targets(self, plan: ControllerPlan) -> Iterator[Mistake]:
        """Check that `into` names other controllers of the file, each once."""
        name = plan.name
        for index, target in enumerate(plan.into):
            at = (*_path(name), "into", index)
            if target == name:
                yield Mistake(at, f"`into` of {name} names {name} itself", "name another controller")
            elif target not in self._named:
                known = tuple(one.name for one in self.controllers if one.reference and one.name != name)
                what = f"`into` of {name} names an unknown controller {target}"
                yield Mistake(at, what, suggestion(target, known or tuple(self._named)))
            elif target in plan.into[:index]:
                yield Mistake(at, f"`into` of {name} names {target} twice", "name it once")

    def _exports(self, plan: ControllerPlan) -> Iterator[Mistake]:
        """Check that exactly one controller in `into` accepts the commands for each joint."""
        name, lowers = plan.name, self._lowers(plan)
        if not plan.into or name in self._incomplete:
            return
        if not plan.command:
            what = f"`into` of {name} names {_listed(plan.into)}, but {name} has no commands"
            yield Mistake((*_path(name), "into"), what, "remove `into`, or use another controller type")
            return
        mute = [
            one for one in lowers if not (one.reference and one.joints) and one.name not in self._incomplete
        ]
        for lower in mute:
            what = f"`into` of {name} names {lower.name}, but {lower.name} exports no reference"
            yield Mistake(self._at_into(plan, lower), what, self._exporting(plan))
        known = all(target in self._named and target not in self._incomplete for target in plan.into)
        useful = [one for one in lowers if one not in mute]
        if known and useful:
            yield from self._each_joint(plan, useful)

    def _each_joint(self, plan: ControllerPlan, lowers: Sequence[ControllerPlan]) -> Iterator[Mistake]:
        name = plan.name
        used: set[str] = set()
        missing: list[tuple[int, str]] = []
        partial: dict[str, list[tuple[int, str]]] = {}
        double: dict[tuple[str, ...], list[tuple[int, str]]] = {}
        for index, joint in enumerate(plan.joints):
            found = tuple(one.name for one in self._exporters(plan, joint))
            near = [one.name for one in lowers if joint in one.joints]
            used.update(near)
            if len(found) > 1:
                double.setdefault(found, []).append((index, joint))
            elif not found and near:
                partial.setdefault(near[0], []).append((index, joint))
            elif not found:
                missing.append((index, joint))
        if missing:
            exported = dict.fromkeys(joint for one in lowers for joint in one.joints)
            does = "does" if len(lowers) == 1 else "do"
            what = (
                f"{name} commands {_names(missing)}, but {_listed(one.name for one in lowers)} {does} not "
                f"export {_it(missing)}"
            )
            fix = f"remove {_it(missing)}; exported: {_listed(exported)}"
            yield Mistake(_joint(name, missing[0][0]), what, fix)
        for lower, joints in partial.items():
            exported_interfaces = self._named[lower].reference
            lacking = [each for each in plan.command if each not in exported_interfaces]
            what = (
                f"{name} commands {' and '.join(lacking)} of {_names(joints)}, but {lower} does not export "
                f"{_it(lacking)}"
            )
            fix = f"give both the same interfaces; {lower} exports {' and '.join(exported_interfaces)}"
            yield Mistake((*_path(name), "into", plan.into.index(lower)), what, fix)
        for pair, joints in double.items():
            what = f"{_names(joints)} of {name} is exported by {' and '.join(pair)}"
            yield Mistake(
                _joint(name, joints[0][0]),
                what,
                "export each joint in one controller only, or remove one from `into`",
            )
        idle_ones = [one for one in lowers if one.name not in used and not missing]
        for idle in idle_ones:
            what = f"`into` of {name} names {idle.name}, but {idle.name} exports no joint of {name}"
            yield Mistake(self._at_into(plan, idle), what, f"remove {idle.name} from `into`")

    def _activity(self, plan: ControllerPlan) -> Iterator[Mistake]:
        """Check that a controller with `active: true` commands only controllers that are active too."""
        for lower in self._lowers(plan):
            if plan.active and not lower.active:
                what = f"{plan.name} commands {lower.name}, but only {plan.name} is active from the start"
                fix = f"write active: true in {lower.name}, or active: false in {plan.name}"
                yield Mistake(self._at_into(plan, lower), what, fix)

    def _rates(self, plan: ControllerPlan) -> Iterator[Mistake]:
        """Check that a controller's rate divides that of those in `into`, so that they miss no command."""
        for lower in self._lowers(plan):
            if plan.every and lower.every and plan.every % lower.every:
                what = (
                    f"the rate of {plan.name} (every {_cycles(plan.every)}) does not divide the rate of "
                    f"{lower.name} (every {_cycles(lower.every)})"
                )
                rate = f" ({lower.rate:g} Hz)" if lower.rate is not None else ""
                fix = f"choose the rate of {lower.name}{rate} divided by a whole number"
                key = "rate" if plan.rate is not None else "into"
                yield Mistake((*_path(plan.name), key), what, fix)

    def _reads(self, plan: ControllerPlan) -> Iterator[Mistake]:
        """Check that each interface in `reads` exists; the missing ones of one source are one mistake."""
        missing: dict[str, list[int]] = {}
        for index, interface in enumerate(plan.reads):
            source, _, name = interface.rpartition("/")
            owner = source.partition("/")[0]
            if owner not in self._incomplete and name not in self._readable.get(source, ()):
                missing.setdefault(source, []).append(index)
        for source, indices in missing.items():
            interface = plan.reads[indices[0]]
            more = f" and {len(indices) - 1} more of {source}" if indices[1:] else ""
            what, fix = self._unreadable(interface, source, interface.rpartition("/")[2])
            at = (*_path(plan.name), "reads", indices[0])
            yield Mistake(at, f"{plan.name} reads {interface}{more}, but {what}", fix)

    def _unreadable(self, interface: str, source: str, name: str) -> tuple[str, str]:
        """Return problem and fix for an interface in `reads` that does not exist."""
        owner, _, joint = source.partition("/")
        plan = self._named.get(owner)
        if interface.count("/") not in {1, 2} or "" in interface.split("/"):
            return (
                f"{interface} is not an interface",
                "write JOINT/position, or CONTROLLER/JOINT/position for a reference",
            )
        if source in self._readable:
            return f"{source} has no interface {name}", f"it has {', '.join(self._readable[source])}"
        if plan is None:
            if joint:
                return f"{owner} is not a controller", suggestion(owner, tuple(self._named))
            providing = tuple(one.name for one in self.controllers if one.provides)
            known = (*self.joints, *(one.name for one in self.sources), *providing)
            kind = "joint, device, sensor or controller" if self.sources or providing else "joint"
            return f"{owner} is not a {kind}", suggestion(owner, known)
        return _unexported(plan, joint)

    def _source_commands(self, plan: ControllerPlan) -> Iterator[Mistake]:
        """Check that each name in `source_commands` is a command of a device or sensor."""
        known = [f"{one.name}/{command}" for one in self.sources for command in one.commands]
        for index, name in enumerate(plan.source_commands):
            if name not in known and name.partition("/")[0] not in self._incomplete:
                what = f"{plan.name} commands {name}, but {name} is not a command of a device"
                fix = suggestion(name, known) if known else "add it to `commands` of the device"
                yield Mistake((*_path(plan.name), "source_commands", index), what, fix)

    def _takeovers(self, plan: ControllerPlan) -> Iterator[Mistake]:
        """Check that `takeovers` names other controllers, and that these can be active together."""
        names = plan.takeovers
        for index, name in enumerate(names):
            at = (*_path(plan.name), "takeovers", index)
            if name not in self._named:
                others = [other for other in self._named if other != plan.name]
                yield Mistake(
                    at, f"{plan.name} activates an unknown controller {name}", suggestion(name, others)
                )
            elif name == plan.name:
                yield Mistake(at, f"{name} activates itself", "name another controller")
        known = [self._named[name] for name in names if name in self._named and name not in self._incomplete]
        if found := conflicts_text(conflicts(known)):
            what = f"{plan.name} activates conflicting controllers: {found}"
            yield Mistake((*_path(plan.name), "takeovers", 0), what, "remove one of them")

    def _needed_together(self, plan: ControllerPlan) -> Iterator[Mistake]:
        """Check that all controllers that a controller commands, directly or not, can be active together."""
        found = self._clashes_below(plan)
        for lower in self._lowers(plan):
            found = {pair: clash for pair, clash in found.items() if pair not in self._clashes_below(lower)}
        for (holder, other), clashes in found.items():
            what = (
                f"the chains {self._way(plan, holder)} and {self._way(plan, other)} both command "
                f"{_claimed(clashes)}"
            )
            fix = "remove these joints from one chain, or join the chains by `into`"
            yield Mistake((*_path(plan.name), "into"), what, fix)

    def _clashes_below(self, plan: ControllerPlan) -> dict[tuple[str, str], list[Conflict]]:
        """Return the conflicting claims among a controller and all that it commands, by pair of them."""
        names = {plan.name, *below(self.controllers, plan.name)} - self._incomplete if plan.into else set()
        return _by_pairs(conflicts(one for one in self.controllers if one.name in names))

    def _way(self, plan: ControllerPlan, end: str) -> str:
        """Return the shortest chain of `into` from a controller to another: `arm -> limiter -> pid`."""
        ways: list[tuple[str, ...]] = [(plan.name,)]
        seen = {plan.name}
        for way in ways:
            if way[-1] == end:
                return " -> ".join(way)
            further = [one.name for one in self._lowers(self._named[way[-1]]) if one.name not in seen]
            seen.update(further)
            ways += [(*way, name) for name in further]
        return end

    def _circles(self) -> Iterator[Mistake]:
        for circle in circles(self.controllers):
            if len(circle) == 1:
                continue  # `_targets` reports a controller that is into itself
            following = dict(zip(circle, (*circle[1:], circle[0]), strict=True))
            begin = next((one for one in circle if following[one] in self._named[one].into), circle[0])
            into = self._named[begin].into
            at = (
                (*_path(begin), "into", into.index(following[begin]))
                if following[begin] in into
                else _path(begin)
            )
            what = f"controllers command each other in a circle: {drawn(circle)}"
            if not all(after in self._named[one].into for one, after in following.items()):
                what = f"controllers depend on each other in a circle, by `into` and `reads`: {drawn(circle)}"
            yield Mistake(at, what, "remove one of these links")

    def _active_claims(self) -> Iterator[Mistake]:
        """Check that no two controllers with `active: true` claim the same servo or reference."""
        active = [plan for plan in self.controllers if plan.active and plan.name not in self._incomplete]
        reported = {pair for plan in self.controllers for pair in self._clashes_below(plan)}
        for (holder, other), clashes in _by_pairs(conflicts(active)).items():
            if (holder, other) in reported:
                continue
            verb = "command" if clashes[0].reference else "claim"
            what = f"{other} and {holder} are both active and both {verb} {_claimed(clashes)}"
            ways = [way for name in (other, holder) if "->" in (way := self._from_above(name))]
            if ways:
                what += f" (chain{'s' * (len(ways) > 1)} {' and '.join(ways)})"
            joints = [joint for joint in dict.fromkeys(clash.joint for clash in clashes) if joint]
            of = f"joint{'s' * (len(joints) > 1)}" if joints else "device"
            fix = f"write active: false in one controller, or remove the {of} from it"
            at = self._named[other].joints.index(joints[0]) if joints else None
            yield Mistake(_path(other) if at is None else _joint(other, at), what, fix)

    def _from_above(self, name: str) -> str:
        """Return the chain of active controllers that command a controller, as text that ends in its name."""
        way = [name]
        while upper := next(
            (p for p in self.controllers if way[0] in p.into and p.name not in way and p.active), None
        ):
            way.insert(0, upper.name)
        return " -> ".join(way)

    def _fallback(self, plan: ControllerPlan) -> Iterator[Mistake]:
        """Check that a fallback exists, is another controller, and can replace its failed controller."""
        name, at = plan.name, (*_path(plan.name), "fallback")
        if not plan.fallback:
            return
        other = self._named.get(plan.fallback)
        if other is None:
            what = f"the fallback {plan.fallback} of {name} is not a controller of the robot"
            yield Mistake(at, what, suggestion(plan.fallback, tuple(self._named)))
        elif other is plan:
            yield Mistake(at, f"{name} is its own fallback", "name another controller, or remove `fallback`")
        elif name in below(self.controllers, other.name):
            what = (
                f"the fallback {other.name} of {name} commands the failed {name} ({self._way(other, name)})"
            )
            yield Mistake(at, what, f"name a controller independent of {name}")
        elif plan.active and other.active:
            what = f"the fallback {other.name} of {name} is active from the start"
            fix = f"write active: false in {other.name}"
            yield Mistake(at, what, fix)
        elif plan.active and not {name, other.name} & self._incomplete and not circles(self.controllers):
            yield from self._taking_over(plan, other, at)

    def _taking_over(self, plan: ControllerPlan, fallback: ControllerPlan, at: KeyPath) -> Iterator[Mistake]:
        """Yield a mistake if another active controller's claims would keep a fallback from taking over."""
        known = {one.name: one for one in self.controllers if one.name not in self._incomplete}
        taken = [name for name in (plan.name, *above(self.controllers, plan.name)) if name in known]
        active = {name: one for name, one in known.items() if one.active and name not in taken}
        standing = ControllerSnapshot(known, active)
        if standing.fall_back(fallback.name, taken, {plan.name}):
            return
        entering = {fallback.name, *below(self.controllers, fallback.name)}
        free = standing.only_under(taken) - entering  # these controllers would be deactivated
        kept = [one for name, one in active.items() if name not in free | entering]
        after = [*kept, *(one for name, one in known.items() if name in entering)]
        clashes = [one for one in conflicts(after) if one.other in entering and one.holder not in entering]
        for holder, other in dict.fromkeys((one.holder, one.other) for one in clashes):
            through = "" if other == fallback.name else f" through {other}"
            what = (
                f"the fallback {fallback.name} of {plan.name} claims joints of the active {holder}{through}"
            )
            yield Mistake(at, what, f"remove these joints from {other}, or name another controller")

    # Words

    def _at_into(self, plan: ControllerPlan, lower: ControllerPlan) -> KeyPath:
        return (*_path(plan.name), "into", plan.into.index(lower.name))

    def _exporting(self, plan: ControllerPlan) -> str:
        names = [one.name for one in self.controllers if one.reference and one.name != plan.name]
        return (
            f"controllers with references: {_listed(names)}"
            if names
            else "remove `into`; no controller of the robot exports references"
        )


def _unexported(plan: ControllerPlan, joint: str) -> tuple[str, str]:
    """Return problem and fix for a reference in `reads` that an existing controller does not export."""
    if not (plan.reference and plan.joints):
        return f"{plan.name} exports no reference", "read a joint: JOINT/position"
    if not joint:
        example = f"{plan.name}/{plan.joints[0]}/{plan.reference[0]}"
        return f"{plan.name} is a controller", f"name a joint too: {example}"
    return f"{plan.name} does not export {joint}", f"exported: {_listed(plan.joints)}"


def _path(controller: str) -> KeyPath:
    return ("controllers", controller)


def _joint(controller: str, index: int) -> KeyPath:
    return (*_path(controller), "joints", index)


def _listed(names: Iterable[str]) -> str:
    names = list(names)
    more = f" and {len(names) - _LONGEST} more" if len(names) > _LONGEST else ""
    return ", ".join(names[:_LONGEST]) + more


def _names(joints: Sequence[tuple[int, str]]) -> str:
    return _listed(joint for _, joint in joints)


def _it(joints: Sequence[object]) -> str:
    return "it" if len(joints) == 1 else "them"


def _by_pairs(clashes: Iterable[Conflict]) -> dict[tuple[str, str], list[Conflict]]:
    found: dict[tuple[str, str], list[Conflict]] = {}
    for clash in clashes:
        found.setdefault((clash.holder, clash.other), []).append(clash)
    return found


def _claimed(clashes: Iterable[Conflict]) -> str:
    return _listed(dict.fromkeys(clash.reference or clash.joint for clash in clashes))


def _cycles(every: int) -> str:
    return "cycle" if every == 1 else f"{every} cycles"
