"""What one exchange with the servos costs, ours and others', side by side in one run."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from dxlrun_lab.late_servos import Sent, transactions
from dxlsim.bus.ledger import LedgerEntry, read_ledger
from exchange.canned import CannedResponder
from exchange.case import Case
from exchange.figures import CaseFigures, WireFigures, host_figures, wire_figures
from exchange.hosts import HOSTS, Host, HostKind
from exchange.rounds import Measured, cores, measure, on_core
from exchange.simulated import SimulatedServos
from exchange.wire import judge

Against = Literal["canned", "simulated"]
Progress = Callable[[str, float], None]
"""Takes words and the share that is done."""
_BITS_A_BYTE = 10
_MOST_MENDS = 100


@dataclass(frozen=True, slots=True)
class Settings:
    """How each case is measured."""

    hosts: Sequence[HostKind]
    seconds: float
    """Of each case, for all hosts together."""
    values: bool = True
    """The peers turn bytes into values."""


@dataclass(frozen=True, slots=True)
class BusBench:
    """What was found."""

    cores: tuple[int, int]
    """Of the host, and of what answers."""
    cases: tuple[CaseFigures, ...]
    missing: tuple[str, ...]
    """Hosts that are not installed here."""


def chosen_hosts(names: Sequence[str]) -> list[HostKind]:
    """Return the hosts of some names, in the order of HOSTS."""
    return [kind for kind in HOSTS if kind.name in names]


def bench_bus(
    cases: Sequence[tuple[Against, Case]], settings: Settings, progress: Progress = lambda *_: None
) -> BusBench:
    """Measure each case, against canned replies or simulated servos with a wire."""
    missing = tuple(kind.name for kind in settings.hosts if kind.missing)
    ours, theirs = cores()
    found: list[CaseFigures] = []
    with on_core(ours):
        for number, (against, case) in enumerate(cases):
            words = f"{against}: Protocol {case.protocol:.1f}, {case.servos} x {case.model}"

            def report(share: float, words: str = words, number: int = number) -> None:
                progress(words, (number + share) / len(cases))

            able = [kind for kind in settings.hosts if not kind.missing and case.protocol in kind.protocols]
            if able:
                measured = _canned if against == "canned" else _simulated
                found.append(measured(case, replace(settings, hosts=able), theirs, report))
    return BusBench((ours, theirs), tuple(found), missing)


def to_json(result: BusBench) -> bytes:
    """Encode what was found."""
    return msgspec.json.format(msgspec.json.encode(result))


@contextmanager
def _made(case: Case, settings: Settings, ports: Sequence[str], *, wire: bool) -> Iterator[dict[str, Host]]:
    plan = case.plan(wire=wire)
    with ExitStack() as stack:
        hosts: dict[str, Host] = {}
        for kind, port in zip(settings.hosts, ports, strict=True):
            hosts[kind.name] = kind.make(port, case, plan, settings.values)
            stack.callback(hosts[kind.name].close)
        yield hosts


def _canned(case: Case, settings: Settings, core: int, progress: Callable[[float], None]) -> CaseFigures:
    with ExitStack() as stack:
        responder = CannedResponder([case.simulated(kind.name) for kind in settings.hosts], core)
        stack.callback(responder.close)
        hosts = stack.enter_context(_made(case, settings, responder.ports, wire=False))
        numbers = {name: number for number, name in enumerate(hosts)}
        steps = {name: responder.rehearse(numbers[name], host, first=True) for name, host in hosts.items()}

        def recover(name: str) -> None:
            responder.rehearse(numbers[name], hosts[name], first=False)

        found = measure(hosts, settings.seconds, recover=recover, progress=progress)
    sizes = {
        name: (float(sum(sent for sent, _ in each)), float(sum(got for _, got in each)))
        for name, each in steps.items()
    }
    hosts_ = host_figures(found, sizes, {})
    return CaseFigures("canned", case.protocol, case.model, case.servos, None, hosts_)


def _simulated(case: Case, settings: Settings, core: int, progress: Callable[[float], None]) -> CaseFigures:
    with tempfile.TemporaryDirectory(prefix="dxlrun-bench-") as folder, ExitStack() as stack:
        ledger = Path(folder) / "ledger.jsonl"
        with SimulatedServos([case.simulated(kind.name) for kind in settings.hosts], core, ledger) as servos:
            hosts = stack.enter_context(_made(case, settings, servos.ports, wire=True))
            for host in hosts.values():
                host.start()

            def recover(name: str) -> None:
                for _ in range(_MOST_MENDS):
                    hosts[name].recover()
                    if hosts[name].exchange():
                        return

            found = measure(hosts, settings.seconds, recover=recover, progress=progress)
            sent = {name: host.sent() for name, host in hosts.items()}
        entries = read_ledger(ledger)
    sizes: dict[str, tuple[float, float]] = dict.fromkeys(found, (0.0, 0.0))
    wires: dict[str, WireFigures] = {}
    for name, one in found.items():
        if one.walls_ns:
            mine = [entry for entry in entries if entry.bus == name]
            sizes[name], wires[name] = _judged(case, one, mine, sent[name])
    return CaseFigures(
        "simulated",
        case.protocol,
        case.model,
        case.servos,
        case.baud_rate,
        host_figures(found, sizes, wires),
    )


def _judged(
    case: Case, one: Measured, entries: Sequence[LedgerEntry], sent: Sent
) -> tuple[tuple[float, float], WireFigures]:
    """Return the bytes of an exchange by the ledger, and the exchange against their wire time."""
    byte_ns = _BITS_A_BYTE * 1e9 / case.baud_rate
    walls = np.concatenate(one.walls_ns)
    starts = np.concatenate(
        [
            start + np.cumsum([0, *walls_[:-1]])
            for start, walls_ in zip(one.starts_ns, one.walls_ns, strict=True)
        ]
    )
    lateness = judge(transactions(entries, sent, byte_ns), starts, walls)
    size = lateness.sent_bytes, lateness.received_bytes
    return size, wire_figures(walls.astype(float), lateness.late_ns.astype(float), sum(size) * byte_ns)
