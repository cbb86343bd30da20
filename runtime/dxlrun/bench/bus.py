"""`bench bus`: what one exchange with the servos costs, ours and others', side by side in one run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import msgspec
import numpy as np

from dxlrun.bench.canned import CannedResponder
from dxlrun.bench.case import Case
from dxlrun.bench.hosts import HOSTS, Host, HostKind
from dxlrun.bench.rounds import Measured, cores, measure, on_core


@dataclass(frozen=True, slots=True)
class HostFigures:
    """One host in one case; microseconds."""

    host: str
    exchanges: int
    lost: int
    """Exchanges in which a reply was lost; they count in nothing else."""
    sent_bytes: int
    received_bytes: int
    median_us: float
    p99_us: float
    processor_us: float
    """Processor time of the host's process, an exchange; median of the rounds."""
    wall_ratio: dict[str, float]
    """By other host: our median as a share of its, median of the rounds."""
    processor_ratio: dict[str, float]


@dataclass(frozen=True, slots=True)
class CaseFigures:
    """All hosts in one case."""

    against: str
    """canned, simulated"""
    protocol: float
    model: str
    servos: int
    hosts: tuple[HostFigures, ...]


@dataclass(frozen=True, slots=True)
class BusBench:
    """What `bench bus` found."""

    cores: tuple[int, int]
    """Of the host, and of who answers."""
    cases: tuple[CaseFigures, ...]
    missing: tuple[str, ...]
    """Hosts that are not installed here."""


def chosen_hosts(names: Sequence[str]) -> list[HostKind]:
    """Return the hosts of some names, in the order of HOSTS."""
    return [kind for kind in HOSTS if kind.name in names]


def bench_bus(
    cases: Sequence[Case],
    hosts: Sequence[HostKind],
    seconds: float,
    *,
    values: bool = True,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> BusBench:
    """Measure each case against canned replies for `seconds`; `progress` takes words and the share done."""
    here = [kind for kind in hosts if not kind.missing]
    ours, theirs = cores()
    found: list[CaseFigures] = []
    with on_core(ours):
        for number, case in enumerate(cases):
            words = f"Protocol {case.protocol:.1f}, {case.servos} x {case.model}"

            def told(share: float, words: str = words, number: int = number) -> None:
                progress(words, (number + share) / len(cases))

            found.append(_canned(case, here, seconds, core=theirs, values=values, progress=told))
    return BusBench((ours, theirs), tuple(found), tuple(kind.name for kind in hosts if kind.missing))


def _canned(
    case: Case,
    kinds: Sequence[HostKind],
    seconds: float,
    *,
    core: int,
    values: bool,
    progress: Callable[[float], None],
) -> CaseFigures:
    plan = case.plan(wire=False)
    with ExitStack() as stack:
        responder = CannedResponder([case.simulated(kind.name) for kind in kinds], core)
        stack.callback(responder.close)
        hosts: dict[str, Host] = {}
        for kind, port in zip(kinds, responder.ports, strict=True):
            hosts[kind.name] = kind.make(port, case, plan, values)
            stack.callback(hosts[kind.name].close)
        steps = {
            name: responder.rehearse(number, host, first=True)
            for number, (name, host) in enumerate(hosts.items())
        }
        numbers = {name: number for number, name in enumerate(hosts)}
        found = measure(
            hosts,
            seconds,
            recover=lambda name: _again(responder, numbers[name], hosts[name]),
            progress=progress,
        )
    sizes = {
        name: (sum(sent for sent, _ in each), sum(got for _, got in each)) for name, each in steps.items()
    }
    return CaseFigures("canned", case.protocol, case.model, case.servos, figures(found, sizes))


def _again(responder: CannedResponder, number: int, host: Host) -> None:
    responder.rehearse(number, host, first=False)


def figures(found: dict[str, Measured], sizes: dict[str, tuple[int, int]]) -> tuple[HostFigures, ...]:
    """Return what was measured in figures; ratios are taken round by round, as the machine changes."""
    return tuple(_figures(name, one, found, sizes[name]) for name, one in found.items())


def _figures(name: str, one: Measured, found: dict[str, Measured], sizes: tuple[int, int]) -> HostFigures:
    walls = np.concatenate(one.walls_ns) / 1e3 if one.walls_ns else np.array([np.nan])
    others = {other: each for other, each in found.items() if other != name}
    return HostFigures(
        host=name,
        exchanges=sum(map(len, one.walls_ns)),
        lost=one.lost,
        sent_bytes=sizes[0],
        received_bytes=sizes[1],
        median_us=round(float(np.median(walls)), 1),
        p99_us=round(float(np.quantile(walls, 0.99)), 1),
        processor_us=round(float(np.median(one.processor_ns or [np.nan])) / 1e3, 1),
        wall_ratio={
            other: _ratio(one.wall_medians_ns, each.wall_medians_ns) for other, each in others.items()
        },
        processor_ratio={
            other: _ratio(np.array(one.processor_ns), np.array(each.processor_ns))
            for other, each in others.items()
        },
    )


def _ratio(
    ours: np.ndarray[tuple[int], np.dtype[np.float64]], theirs: np.ndarray[tuple[int], np.dtype[np.float64]]
) -> float:
    rounds = min(len(ours), len(theirs))  # a round that lost a reply is missing: then neighbours are compared
    return round(float(np.median(ours[:rounds] / theirs[:rounds])), 3) if rounds else float("nan")


def to_json(result: BusBench) -> bytes:
    """Encode what was found."""
    return msgspec.json.format(msgspec.json.encode(result))
