"""Conditions of a latency measurement, number of wake-ups of each, and order of their blocks.

Conditions are compared in alternating blocks, because a machine drifts (other programs, temperature, a busy
host of a virtual machine). Each block has all conditions, and their order changes from block to block, so
that the drift affects all of them alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dxlrun import InputError
from dxlrun.tooling.files import suggestion
from dxlrun.tooling.output import counted
from dxlrun.tooling.plans import Policy, SchedulerPlan

YARDSTICK = "c"
POLICIES: tuple[Policy, ...] = ("other", "round_robin", "fifo")
REAL_TIME: Policy = "round_robin"

SHORTEST_NS, LONGEST_NS = 10_000, 1_000_000_000
"""Shortest and longest period of a measurement: from the highest rate of a robot file, 100 kHz, to the
lowest that a run accepts."""
MOST_ITERATIONS = 10_000_000  # Per condition; 16 bytes each
LONGEST_S = 24 * 3600.0  # One day
MOST_BLOCKS = 1000


@dataclass(frozen=True, slots=True)
class Condition:
    """Way of waiting for a deadline that is measured: by dxlrun's loop or by a C program, with a
    scheduling policy."""

    name: str  # Name in --compare: other, round_robin, fifo, c
    policy: Policy

    @property
    def in_c(self) -> bool:
        """True for the yardstick, a C program that sleeps until the deadline."""
        return self.name == YARDSTICK

    @property
    def label(self) -> str:
        """Name of the condition in tables."""
        return f"{self.name} ({self.policy})" if self.in_c else self.name


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a latency measurement."""

    iterations: int  # Per condition, over all blocks
    period_ns: int
    priority: int
    conditions: tuple[Condition, ...]
    blocks: int
    cores: tuple[int, ...] = ()  # Cores of all conditions; empty for any core
    polling_ns: int | None = None
    """Longest time that the clock is polled before a deadline; None: a tenth of the period, as in a run."""
    idle_latency: bool = False  # Keep the cores from deep idle states during the measurement

    @property
    def seconds(self) -> float:
        """Duration of the measurement, over all conditions, s."""
        return self.iterations * self.period_ns * len(self.conditions) / 1e9

    def share(self, block: int) -> int:
        """Return the number of wake-ups of each condition in a block; the first blocks share a remainder."""
        whole, rest = divmod(self.iterations, self.blocks)
        return whole + (block < rest)

    def scheduler(self, condition: Condition, lock_memory: bool) -> SchedulerPlan:
        """Return the scheduler settings of the process that measures a condition."""
        return SchedulerPlan(
            policy=condition.policy,
            priority=self.priority,
            lock_memory=lock_memory,
            cores=self.cores,
            polling_ns=self.polling_ns,
        )

    def validate_settings(self, allowed_cores: frozenset[int]) -> None:
        """Check that a measurement with these settings is possible on the allowed cores.

        Raises:
            InputError: One sentence for each value that does not allow a measurement.
        """
        problems: list[str] = []
        if not SHORTEST_NS <= self.period_ns <= LONGEST_NS:
            problems.append(f"--period of {self.period_ns * 1e-9:g} s: give from 10 us to 1 s")
        if not 1 <= self.iterations <= MOST_ITERATIONS:
            problems.append(f"--count {self.iterations}: give from 1 to {MOST_ITERATIONS:,}")
        if not 1 <= self.priority <= 99:
            problems.append(f"--priority {self.priority}: real-time priorities are 1 to 99")
        if not 1 <= self.blocks <= MOST_BLOCKS:
            problems.append(f"--blocks {self.blocks}: give from 1 to {MOST_BLOCKS}")
        elif 1 <= self.iterations < self.blocks:
            problems.append(
                f"{counted(self.iterations, 'iteration', 'iterations')} cannot be divided into {self.blocks} "
                "blocks; give more iterations, or fewer blocks"
            )
        if missing := sorted(set(self.cores) - allowed_cores):
            problems.append(
                f"--cores: core {', '.join(map(str, missing))} is not available to this process; "
                f"choose from {', '.join(map(str, sorted(allowed_cores)))}"
            )
        if self.polling_ns is not None and self.polling_ns * 2 > self.period_ns:
            problems.append(
                f"--polling {self.polling_ns / 1e3:g} us is more than half of the period; give "
                f"{self.period_ns / 2e3:g} us or less"
            )
        if not problems and self.seconds > LONGEST_S:
            problems.append(
                f"the measurement would take {self.seconds / 3600:.1f} h, over {LONGEST_S / 3600:.0f} h; "
                "give fewer iterations, or a shorter period"
            )
        if problems:
            raise InputError("\n".join(problems))


def conditions(compare: str | None, policy: Policy | None) -> tuple[Condition, ...]:
    """Return the conditions that `--compare` and `--policy` select.

    Without --compare, the condition is dxlrun's own loop with --policy (other). `c` has the policy of
    --policy, else of the preceding condition, else of the following one. `--compare c` alone compares with
    dxlrun's own loop.

    Raises:
        InputError: One sentence about the first problem.
    """
    if compare is None:
        return (Condition(policy or "other", policy or "other"),)
    names = [name.strip() for name in compare.split(",")]
    known = (*POLICIES, YARDSTICK)
    for number, name in enumerate(names):
        if name not in known:
            raise InputError(f"--compare: {name!r} is not a condition; {suggestion(name, known)}")
        if name in names[:number]:
            raise InputError(f"--compare: {name} is named twice; name each condition once")
    if names == [YARDSTICK]:
        names = [policy or REAL_TIME, YARDSTICK]
    elif len(names) == 1:
        raise InputError(f"--compare {names[0]}: a comparison needs two; use --policy {names[0]} for one")
    elif policy is not None and YARDSTICK not in names:
        raise InputError("with --compare, --policy is only for condition c; add c, or omit --policy")
    return tuple(
        Condition(
            name, (policy or _policy(_neighbour(names, number))) if name == YARDSTICK else _policy(name)
        )
        for number, name in enumerate(names)
    )


def _neighbour(names: Sequence[str], number: int) -> str:
    return names[number - 1] if number else names[1]


def _policy(name: str) -> Policy:
    return next(policy for policy in POLICIES if policy == name)


def order(conditions: Sequence[Condition], block: int) -> tuple[Condition, ...]:
    """Return the order in which a block measures the conditions: rotated from block to block, and reversed
    after a whole round.

    In 2 n blocks of n conditions, each condition is in each place twice. With up to three conditions, each
    one precedes any other as often as it follows it.
    """
    number = len(conditions)
    rounds, turn = divmod(block, number)
    base = tuple(conditions) if rounds % 2 == 0 else tuple(reversed(conditions))
    return base[turn:] + base[:turn]
