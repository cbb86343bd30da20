"""What is measured: conditions, how many wake-ups of each, and in which order their blocks follow.

Conditions are compared in alternating blocks, because a machine drifts (other programs, temperature, a busy
host of a virtual machine): each block has all conditions, and their order changes from block to block, so
that the drift meets all of them alike.
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
"""Of a period: from the highest rate of a robot file, 100 kHz, to the lowest that a run takes."""
MOST_ITERATIONS = 10_000_000  # Of a condition; 16 bytes each
LONGEST_S = 24 * 3600.0
MOST_BLOCKS = 1000


@dataclass(frozen=True, slots=True)
class Condition:
    """One way to wait for a deadline: dxlrun's own with a policy, or the program in C with one."""

    name: str  # As it is written in --compare: other, round_robin, fifo, c
    policy: Policy

    @property
    def in_c(self) -> bool:
        """The yardstick, which sleeps until the deadline."""
        return self.name == YARDSTICK

    @property
    def label(self) -> str:
        """The condition in a table."""
        return f"{self.name} ({self.policy})" if self.in_c else self.name


@dataclass(frozen=True, slots=True)
class Settings:
    """A measurement: wake-ups of each condition, in blocks."""

    iterations: int  # Of each condition, in all blocks together
    period_ns: int
    priority: int
    conditions: tuple[Condition, ...]
    blocks: int
    cores: tuple[int, ...] = ()  # Where all conditions run; empty: anywhere
    polling_ns: int | None = None
    """Longest time that the clock is polled before a deadline; None: a tenth of the period, as in a run."""
    idle_latency: bool = False  # Cores are kept from deep idle states meanwhile

    @property
    def seconds(self) -> float:
        """How long all wake-ups take."""
        return self.iterations * self.period_ns * len(self.conditions) / 1e9

    def share(self, block: int) -> int:
        """Return the wake-ups of a condition in a block: as many in each, the rest in the first ones."""
        whole, rest = divmod(self.iterations, self.blocks)
        return whole + (block < rest)

    def scheduler(self, condition: Condition, lock_memory: bool) -> SchedulerPlan:
        """Return what a condition requests of the operating system, as a robot file would."""
        return SchedulerPlan(
            policy=condition.policy,
            priority=self.priority,
            lock_memory=lock_memory,
            cores=self.cores,
            polling_ns=self.polling_ns,
        )

    def check(self, allowed_cores: frozenset[int]) -> None:
        """Raise InputError with a sentence for each value with which nothing can be measured."""
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
                f"--cores: this process may not run on core {', '.join(map(str, missing))}; "
                f"it may on {', '.join(map(str, sorted(allowed_cores)))}"
            )
        if self.polling_ns is not None and self.polling_ns * 2 > self.period_ns:
            problems.append(
                f"--polling {self.polling_ns / 1e3:g} us is more than half of the period, which is the most "
                "that a loop polls; give less"
            )
        if not problems and self.seconds > LONGEST_S:
            problems.append(
                f"this would take {self.seconds / 3600:.1f} h, and {LONGEST_S / 3600:.0f} h are the most; "
                "give fewer iterations, or a shorter period"
            )
        if problems:
            raise InputError("\n".join(problems))


def conditions(compare: str | None, policy: Policy | None) -> tuple[Condition, ...]:
    """Return what `--compare` and `--policy` ask for; raises InputError with one sentence.

    Without --compare it is dxlrun's own loop with --policy (other). `c` has the policy of --policy, else of
    the condition before it, else of the one behind it; `--compare c` alone compares with dxlrun's own.
    """
    if compare is None:
        return (Condition(policy or "other", policy or "other"),)
    names = [name.strip() for name in compare.split(",")]
    known = (*POLICIES, YARDSTICK)
    for number, name in enumerate(names):
        if name not in known:
            raise InputError(
                f"--compare: {name!r} is no condition; "
                f"{suggestion(name, known)}, and write them like other,round_robin,c"
            )
        if name in names[:number]:
            raise InputError(f"--compare: {name} is named twice; name each condition once")
    if names == [YARDSTICK]:
        names = [policy or REAL_TIME, YARDSTICK]
    elif len(names) == 1:
        raise InputError(f"--compare {names[0]}: a comparison takes two; use --policy {names[0]} for one")
    elif policy is not None and YARDSTICK not in names:
        raise InputError("--policy is for c where conditions are compared, and c is not among them; leave it")
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
    """Return the order of the conditions in a block: rotated, and reversed after a whole round.

    In 2 n blocks of n conditions each stands in each place twice, and (up to three) in front of each other
    one as often as behind it.
    """
    number = len(conditions)
    rounds, turn = divmod(block, number)
    base = tuple(conditions) if rounds % 2 == 0 else tuple(reversed(conditions))
    return base[turn:] + base[:turn]
