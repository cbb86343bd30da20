"""Figures: what was measured as numbers for a person or a program; microseconds and shares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from exchange.rounds import Measured

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class WireFigures:
    """One host against the computed wire time."""

    wire_us: float
    """What the bytes of an exchange take on the wire, with the servos' return delays."""
    late_us: float
    """Median lateness of the simulated servos in an exchange."""
    beyond_us: float
    """Median of the exchange without that lateness."""
    ratio: float
    """`beyond_us` as a multiple of `wire_us`."""


@dataclass(frozen=True, slots=True)
class HostFigures:
    """One host in one case."""

    host: str
    exchanges: int
    lost: int
    """Exchanges in which a reply was lost; they count in nothing else."""
    sent_bytes: float
    """An exchange."""
    received_bytes: float
    p10_us: float
    """On a busy machine the quickest tenth still shows which host takes less."""
    median_us: float
    p99_us: float
    processor_us: float
    """Processor time of the host's process, an exchange; median of the rounds."""
    wall_ratio: dict[str, float]
    """By other host: our median as a share of its, round by round, their median."""
    processor_ratio: dict[str, float]
    wire: WireFigures | None = None
    """None: against canned replies there is no wire."""


@dataclass(frozen=True, slots=True)
class CaseFigures:
    """All hosts in one case."""

    against: str
    """canned, simulated"""
    protocol: float
    model: str
    servos: int
    baud_rate: int | None
    """bit/s; None: there is no wire"""
    hosts: tuple[HostFigures, ...]


def host_figures(
    found: Mapping[str, Measured],
    sizes: Mapping[str, tuple[float, float]],
    wires: Mapping[str, WireFigures],
) -> tuple[HostFigures, ...]:
    """Return what was measured in figures; ratios are taken round by round, as the machine changes."""
    return tuple(_figures(name, found, sizes[name], wires.get(name)) for name in found)


def wire_figures(wall_ns: Floats, late_ns: Floats, wire_ns: float) -> WireFigures:
    """Return exchanges of some duration, of some lateness that is not theirs, against their wire time."""
    beyond = float(np.median(wall_ns - late_ns))
    return WireFigures(
        wire_us=round(wire_ns / 1e3, 1),
        late_us=round(float(np.median(late_ns)) / 1e3, 1),
        beyond_us=round(beyond / 1e3, 1),
        ratio=round(beyond / wire_ns, 3),
    )


def _figures(
    name: str, found: Mapping[str, Measured], sizes: tuple[float, float], wire: WireFigures | None
) -> HostFigures:
    one = found[name]
    walls = np.concatenate(one.walls_ns) / 1e3 if one.walls_ns else np.array([np.nan])
    others = {other: each for other, each in found.items() if other != name}
    processor = np.array(one.processor_ns or [np.nan])
    return HostFigures(
        host=name,
        exchanges=one.exchanges,
        lost=one.lost,
        sent_bytes=round(sizes[0], 1),
        received_bytes=round(sizes[1], 1),
        p10_us=round(float(np.quantile(walls, 0.1)), 1),
        median_us=round(float(np.median(walls)), 1),
        p99_us=round(float(np.quantile(walls, 0.99)), 1),
        processor_us=round(float(np.median(processor)) / 1e3, 1),
        wall_ratio={
            other: _ratio(one.wall_medians_ns, each.wall_medians_ns) for other, each in others.items()
        },
        processor_ratio={
            other: _ratio(processor, np.array(each.processor_ns)) for other, each in others.items()
        },
        wire=wire,
    )


def _ratio(ours: Floats, theirs: Floats) -> float:
    rounds = min(len(ours), len(theirs))  # a round that lost a reply is missing: then neighbours are compared
    return round(float(np.median(ours[:rounds] / theirs[:rounds])), 3) if rounds else float("nan")
