"""Result of the tracking experiment for the terminal, as JSON, and as a page."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from dxlrun.tooling.html import document, footer, header, section, table_element
from dxlrun.tooling.output import Column, Part, Sentence, Table, Value, counted, flagged, microseconds
from dxlrun_lab.tracking.motion_evaluation import SetupFigures
from dxlrun_lab.tracking.tracking_experiment import TrackingExperiment

_THESIS = "M. A. Araujo, UFU 2017, section 5.3.3"


def parts(experiment: TrackingExperiment) -> tuple[Part, ...]:
    """Return the experiment's output for the terminal: table, findings, paths of logs, and remarks."""
    tracked = _tracked(experiment)
    return (
        table(tracked),
        *sentences(experiment),
        *(f"log: {one.log}" for one in tracked),
        *(Sentence(f"{one.setup}: {text}", "warning") for one in tracked for text in one.remarks),
    )


def result(experiment: TrackingExperiment) -> dict[str, object]:
    """Return the content of the JSON output of the experiment."""
    motion = experiment.motion
    return {
        "robot": experiment.robot,
        "motion": motion.file,
        "joint": motion.joint,
        "motion_ns": motion.duration_ns,
        "period_ns": experiment.period_ns,
        "machine": machine(),
        "load": experiment.load,
        "interrupted": experiment.interrupted,
        "failures": experiment.failures,
        "sentences": sentences(experiment),
        "setups": _tracked(experiment),
    }


def machine() -> str:
    """Describe this machine: kernel with version, which shows if it is a real-time one, and cores."""
    here = os.uname()
    cores = counted(len(os.sched_getaffinity(0)), "core", "cores")
    return f"{here.sysname} {here.release} ({here.version}), {cores}"


def _tracked(experiment: TrackingExperiment) -> list[SetupFigures]:
    return [one.tracked for one in experiment.measured]


def table(tracked: Sequence[SetupFigures]) -> Table:
    """Return a table with one column per set-up, which fits a terminal.

    The lateness of the simulated bus has its own row. It is only included in the duration.
    """
    rows: list[tuple[str, Callable[[SetupFigures], Value]]] = [
        ("duration", lambda one: f"{one.duration_ns / 1e9:.3f} s"),
        ("drift", _drift),
        ("error rms", lambda one: f"{one.rms_rad:.4f} rad"),
        ("largest error", lambda one: f"{one.worst_rad:.4f} rad"),
        ("cycles", lambda one: one.cycles),
        ("late", lambda one: one.late_cycles),
        ("mean late", lambda one: _us(one.mean_late_us)),
        ("largest late", lambda one: _us(one.max_late_us)),
        ("no reply", lambda one: flagged(one.silent_cycles)),
    ]
    if any(one.late_by_bus_us is not None for one in tracked):
        rows.append(("simulated bus", lambda one: _us(one.late_by_bus_us)))
    columns = (Column("", "name"), *(Column(one.setup, missing="-") for one in tracked))
    return Table.from_rows("", columns, ((name, *(value(one) for one in tracked)) for name, value in rows))


def _drift(one: SetupFigures) -> str:
    return "not ended" if one.own_drift_ns is None else microseconds(max(0, one.own_drift_ns) / 1e3)


def _us(value: float | None) -> str | None:
    return None if value is None else microseconds(value)


def sentences(experiment: TrackingExperiment) -> list[str]:
    """Return one sentence per set-up: how late the motion ended and why, or how long it was measured."""
    tracked = _tracked(experiment)
    found = [_of_sequence(one) for one in tracked if one.start_delays_ns is not None and one.ended]
    found += [_of_loop(one) for one in tracked if one.start_delays_ns is None and one.ended]
    found += [
        f"{one.setup}: measured for {one.duration_ns / 1e9:.1f} of {experiment.motion.duration_ns / 1e9:g} s."
        for one in tracked
        if not one.ended
    ]
    return found


def _of_sequence(one: SetupFigures) -> str:
    if one.drift_ns is None or one.start_delays_ns is None or not one.adds_up:
        return f"{one.setup}: the log lacks cycles, so its delays do not add up."
    bus = "" if one.late_by_bus_us is None else " (with the delay of the simulated bus)"
    return (
        f"{one.setup}: ended {microseconds(one.drift_ns / 1e3)} late{bus}, exactly the sum of its start "
        f"delays ({one.start_delays_ns} ns in {one.cycles - 1} poses)."
    )


def _of_loop(one: SetupFigures) -> str:
    drift, late = (microseconds(max(0, ns) / 1e3) for ns in (one.drift_ns or 0, one.last_late_ns))
    return f"{one.setup}: ended {drift} late; the final cycle started {late} late."


def page(experiment: TrackingExperiment) -> str:
    """Return the HTML report of an experiment with at least one measured set-up. Needs matplotlib."""
    from dxlrun_lab.tracking.figures import drawings

    tracked, motion = _tracked(experiment), experiment.motion
    drawn = drawings(experiment.measured, motion)
    load = f"under load ({experiment.load})" if experiment.load else "without load"
    top = header(
        "Tracking experiment",
        f"{experiment.robot}, {motion.file}, {load}, {machine()}",
        "Result",
        sentences(experiment),
        not experiment.failures and not experiment.interrupted,
        [(one.setup, _key(one)) for one in tracked],
    )
    facts = Table.facts(
        "",
        (
            ("drift", "measured duration minus duration of the motion"),
            ("error", "desired minus read position, both at the time of reading"),
            (
                "late",
                "cycles started more than 150 us late, counted from the first skipped deadline if any",
            ),
            ("mean, largest late", "of the late cycles"),
            ("no reply", "cycles without an intact reply of the joint's servo"),
            (
                "simulated bus",
                "total delay of the cycles by simulated servos; duration and the sentences above include it, "
                "all other rows exclude it",
            ),
        ),
    )
    sections = [
        section("table", "Table", [table_element(table(tracked)), table_element(facts)]),
        section("figures", "Figures", drawn),
    ]
    logs = ", ".join(one.log for one in tracked)
    end = footer(f"Made by dxlrun experiment tracking ({_THESIS}) from {logs}.")
    return document("Tracking experiment", top, sections, end, result(experiment))


def _key(one: SetupFigures) -> str:
    drift = one.own_drift_ns
    return "not ended" if drift is None else f"{microseconds(max(0, drift) / 1e3)} late"
