"""Statistics of a latency measurement: the thesis' table, intervals over blocks, ratios of conditions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun_analysis.counts import Numbers, median, quantile
from dxlrun_analysis.cycles.punctuality import ROUGH_NS
from dxlrun_analysis.latency.conditions import Condition, Settings

CONFIDENCE = 0.95
FEW_BLOCKS = 5  # Fewer blocks give wide intervals (t of four degrees of freedom: 2.8)
_MS_NS = 1_000_000

Times = NDArray[np.int64]
"""Deadline and wake-up of each iteration, ns of the monotonic clock; shape (wake-ups, 2)."""


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive wake-ups of one condition that one process measured."""

    condition: str  # Name
    number: int
    times: Times
    cpu_ns: int = 0  # Processor time of the process during the block
    wall_ns: int = 0  # Elapsed time; 0 if the block was interrupted
    margin_ns: int = 0  # Polling time before each deadline

    @property
    def lateness_ns(self) -> Numbers:
        """Lateness of each wake-up, ns."""
        late: Numbers = self.times[:, 1] - self.times[:, 0]
        return late

    @property
    def late_us(self) -> NDArray[np.float64]:
        """Lateness of each wake-up, us."""
        late: NDArray[np.float64] = self.lateness_ns / 1e3
        return late


@dataclass(frozen=True, slots=True)
class ConfidenceInterval:
    """Mean of a quantity over the blocks, with its 95 % confidence interval by Student's t."""

    mean: float
    low: float | None  # None with a single block
    high: float | None


@dataclass(frozen=True, slots=True)
class Figures:
    """Statistics of one condition's wake-ups, as in the thesis' table; us, shares from 0 to 1."""

    name: str
    label: str
    policy: str
    wake_ups: int
    skipped: int  # Deadlines that had passed before the wait for them could begin
    max_us: float
    mean_us: float
    deviation_us: float  # Standard deviation of the population
    mode_us: int  # Lower edge of the fullest bin of 1 us, the smallest of equal ones
    share_over_150_us: float
    share_over_1_ms: float
    median_us: float
    p99_us: float
    p999_us: float
    processor_share: float | None  # Share of one core, over completed blocks; None if there was none
    polling_us: float
    """Time that the clock was polled before each deadline, on average over the blocks; 0 without polling."""
    # mean_us, median_us, p99_us of complete blocks, or of interrupted ones if none is complete.
    over_blocks: dict[str, ConfidenceInterval]
    ratios: dict[str, ConfidenceInterval]
    """Ratios of this condition's mean_us and p99_us to those of the reference condition (the C program, or
    the first) in the same block; empty for the reference."""


@dataclass(frozen=True, slots=True)
class Result:
    """Result of a latency measurement; its fields are those of --json."""

    iterations: int
    period_us: float
    priority: int
    blocks: int
    load: str  # In words; empty without load
    reference: str  # Condition that the others are divided by; empty for a single condition
    conditions: tuple[Figures, ...]  # Conditions that have wake-ups
    remarks: tuple[str, ...]


def figures(
    settings: Settings, blocks: Sequence[Block], load: str = "", remarks: Sequence[str] = ()
) -> Result:
    """Compute the statistics of all conditions that have wake-ups."""
    kept = [block for block in blocks if len(block.times)]
    measured = [
        condition
        for condition in settings.conditions
        if any(block.condition == condition.name for block in kept)
    ]
    reference = next((one for one in measured if one.in_c), measured[0] if measured else None)
    alone = reference is None or len(measured) == 1
    own = [
        _figures(settings, condition, kept, None if alone or condition == reference else reference)
        for condition in measured
    ]
    return Result(
        iterations=settings.iterations,
        period_us=settings.period_ns / 1e3,
        priority=settings.priority,
        blocks=settings.blocks,
        load=load,
        reference="" if alone or reference is None else reference.name,
        conditions=tuple(own),
        remarks=(*remarks, *_few(kept)),
    )


def _few(blocks: Sequence[Block]) -> tuple[str, ...]:
    number = 1 + max((block.number for block in blocks), default=-1)
    if 0 < number < FEW_BLOCKS:
        return (
            f"{number} blocks give wide intervals; give --blocks {FEW_BLOCKS} or more to compare"
            if number > 1
            else f"1 block gives no interval; give --blocks {FEW_BLOCKS} or more to compare",
        )
    return ()


def _figures(
    settings: Settings, condition: Condition, blocks: Sequence[Block], reference: Condition | None
) -> Figures:
    own = [block for block in blocks if block.condition == condition.name]
    late_us = np.concatenate([block.late_us for block in own])
    late_ns = np.concatenate([block.lateness_ns for block in own])
    seen = _seen(late_ns)
    values = _over_blocks(settings, own)
    other = (
        _over_blocks(settings, [block for block in blocks if block.condition == reference.name])
        if reference
        else {}
    )
    finished = [block for block in own if block.wall_ns]
    return Figures(
        name=condition.name,
        label=condition.label,
        policy=condition.policy,
        wake_ups=len(late_us),
        skipped=sum(_skipped(block.times, settings.period_ns) for block in own),
        max_us=float(late_us.max()),
        mean_us=float(late_us.mean()),
        deviation_us=float(late_us.std()),
        mode_us=mode_us(late_ns),
        share_over_150_us=float(np.mean(late_ns > ROUGH_NS)),
        share_over_1_ms=float(np.mean(late_ns > _MS_NS)),
        median_us=median(*seen) / 1e3,
        p99_us=quantile(*seen, 0.99) / 1e3,
        p999_us=quantile(*seen, 0.999) / 1e3,
        processor_share=sum(block.cpu_ns for block in finished) / sum(block.wall_ns for block in finished)
        if finished
        else None,
        polling_us=sum(block.margin_ns for block in own) / len(own) / 1e3,
        over_blocks={
            name: interval([value[name] for value in values.values()])
            for name in ("mean_us", "median_us", "p99_us")
        },
        ratios={
            name: interval(ratios)
            for name in ("mean_us", "p99_us")
            if (
                ratios := [
                    values[number][name] / other[number][name]
                    for number in values
                    if number in other and other[number][name] > 0
                ]
            )
        },
    )


def _over_blocks(settings: Settings, blocks: Sequence[Block]) -> dict[int, dict[str, float]]:
    """Return mean, median and 99 % of the lateness in each block, by its number.

    Interrupted blocks would weigh too much and count only if none is complete.
    """
    whole = [block for block in blocks if len(block.times) >= settings.share(block.number)]
    return {block.number: _of_block(block) for block in whole or blocks}


def _of_block(block: Block) -> dict[str, float]:
    seen = _seen(block.lateness_ns)
    return {
        "mean_us": float(block.late_us.mean()),
        "median_us": median(*seen) / 1e3,
        "p99_us": quantile(*seen, 0.99) / 1e3,
    }


def _seen(late_ns: Numbers) -> tuple[Numbers, Numbers]:
    values, counts = np.unique(late_ns, return_counts=True)
    return values, counts


def _skipped(times: Times, period_ns: int) -> int:
    return int(times[-1, 0] - times[0, 0]) // period_ns + 1 - len(times)


def mode_us(late_ns: NDArray[np.int64]) -> int:
    """Return the most frequent lateness, us: lower edge of the fullest bin, smallest of equal ones."""
    bins, counts = np.unique(late_ns // 1000, return_counts=True)
    return int(bins[int(np.argmax(counts))])


def interval(values: Sequence[float]) -> ConfidenceInterval:
    """Return mean and 95 % confidence interval of independently measured values (Student's t)."""
    number = len(values)
    mean = math.fsum(values) / number
    if number < 2:
        return ConfidenceInterval(mean, None, None)
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (number - 1))
    half = t_quantile(number - 1) * deviation / math.sqrt(number)
    return ConfidenceInterval(mean, mean - half, mean + half)


def t_quantile(freedom: int, confidence: float = CONFIDENCE) -> float:
    """Return the two-sided quantile of Student's t: t with P(|T| < t) = confidence."""
    low, high = 0.0, 1.0
    while _t_probability(high, freedom) < confidence:
        high *= 2
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if _t_probability(middle, freedom) < confidence else (low, middle)
    return high


def _t_probability(t: float, freedom: int) -> float:
    """Return P(|T| < t) of Student's t (Abramowitz and Stegun, 26.7.3 and 26.7.4)."""
    angle = math.atan(t / math.sqrt(freedom))
    sine, square = math.sin(angle), math.cos(angle) ** 2
    odd = freedom % 2
    term = total = (math.cos(angle) if odd else 1.0) if freedom > 1 else 0.0
    for number in range(3 if odd else 2, freedom - 1, 2):
        term *= square * (number - 1) / number
        total += term
    return (angle + sine * total) * 2 / math.pi if odd else sine * total
