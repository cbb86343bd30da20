"""Texts of a run's processes: events of guardian, loop process and simulation."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.channels.event_records import EventCode, Severity, event_text

# Guardian


@event_text(EventCode.GUARDIAN, Severity.INFO)
def line_adjusted(result: str) -> str:
    return result


@event_text(EventCode.GUARDIAN, Severity.WARNING)
def line_remark(remark: str) -> str:
    return remark


@event_text(EventCode.GUARDIAN, Severity.ERROR)
def line_problem(problem: str) -> str:
    return problem


@event_text(EventCode.GUARDIAN, Severity.ERROR)
def line_gone() -> str:
    return "a port is lost and will not be opened again"


@event_text(EventCode.GUARDIAN, Severity.ERROR)
def loop_failed(sentences: Sequence[str]) -> str:
    return "; ".join(sentences)


@event_text(EventCode.GUARDIAN, Severity.WARNING)
def run_cut(sentences: Sequence[str]) -> str:
    return "; ".join(sentences)


@event_text(EventCode.GUARDIAN, Severity.WARNING)
def supervisor_gone(sentence: str) -> str:
    return sentence


# Loop process


@event_text(EventCode.GUARDIAN, Severity.ERROR)
def loop_unwatched() -> str:
    return "neither the supervisor nor the guardian responds: the run ends as `on_exit` requires"


@event_text(EventCode.SIMULATION_STALLED, Severity.WARNING)
def simulation_stalled(waits: str) -> str:
    return f"{waits}: the machine is too busy"


@event_text(EventCode.SETUP, Severity.INFO)
def set_up_aborted() -> str:
    return "the start was aborted on request"


@event_text(EventCode.SETUP, Severity.ERROR)
def start_refused(sentences: Sequence[str]) -> str:
    return "\n".join(sentences)


@event_text(EventCode.LOOP_STOPPED, Severity.FATAL)
def loop_crashed(traceback: str) -> str:
    return traceback
