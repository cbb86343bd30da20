"""What the log of a run must show: each is counted in the story's evidence, where 0 says that it did not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from tests.analysis.stranger.kit import S, Story, instead

from dxlrun.errors import StartUpError
from dxlrun.log.log_reader import Log

Column = np.ndarray[Any, Any]  # What the log has of one joint, by cycle


def column(log: Log, field: str, joint: str, since_s: float = 0.0) -> Column:
    """Return what the log has of a joint from a time on."""
    later = log.cycles[log.cycles["scheduled_ns"] > since_s * S]
    of_joint: Column = later[field][:, log.header.joints.index(joint)]
    return of_joint


def spread(values: Column) -> float:
    """Return how far the largest value is from the smallest."""
    return float(np.nanmax(values) - np.nanmin(values))


def seen(story: Story, field: str, joint: str, holds: Callable[[Column], object]) -> None:
    """Prove that something holds for what the log has of a joint."""

    def check(log: Log) -> None:
        story.evidence[f"{field} of {joint}"] += bool(holds(column(log, field, joint)))

    story.checks.append(check)


def lags(story: Story, joint: str, least: float, since_s: float = 1.0) -> None:
    """Prove that a joint is off its goal by more than so much (rad) at least once after a time."""

    def check(log: Log) -> None:
        off = column(log, "goal_position", joint, since_s) - column(log, "position", joint, since_s)
        story.evidence[f"{joint} off its goal"] += bool(np.nanmax(np.abs(off)) > least)

    story.checks.append(check)


def unread(story: Story, joint: str, least: int) -> None:
    """Prove that a joint's state was not valid in so many cycles."""

    def check(log: Log) -> None:
        story.evidence[f"{joint} not read"] += int((~column(log, "valid", joint)).sum()) >= least

    story.checks.append(check)


def said(story: Story, words: str, least: int = 1) -> None:
    """Prove that so many events have some words."""

    def check(log: Log) -> None:
        story.evidence[words] += sum(words in event.text for event in log.events) >= least

    story.checks.append(check)


def start_refused(story: Story) -> None:
    """Prove that the start is refused, and go on to the log that it leaves."""

    def tries(run: Callable[[], None]) -> Callable[[], None]:
        def tried() -> None:
            try:
                run()
            except StartUpError:
                story.evidence["start refused"] += 1

        return tried

    story.evidence["start refused"] += 0
    story.prepared.append(lambda: instead(story.virtual, "run", tries))


def turns(values: Any) -> int:
    """Return how often what a joint was told to do turned about."""
    ways = np.sign(np.diff(values[~np.isnan(values)]))
    ways = ways[ways != 0]
    return int(np.count_nonzero(ways[1:] != ways[:-1]))
