"""The fit: the numbers of the model with which its simulation is nearest to what was measured.

Output error: each piece of the run is simulated from its commands alone, and positions (and currents, or
duties) are compared with the measured ones. A linear least squares on smoothed accelerations is the start.

Intervals are linearised, with residuals that hang together taken into account: the covariance is the
sandwich of K.-Y. Liang and S. L. Zeger, "Longitudinal data analysis using generalized linear models"
(Biometrika 73, 1986), with the pieces of a second as clusters, jackknifed as they are few (R. M. Bell and
D. F. McCaffrey, Survey Methodology 28, 2002), and Student's t of as many.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy import optimize, signal, stats

from dxlrun import InputError
from dxlrun_lab.identify.measured import Compared, Measured
from dxlrun_lab.identify.model import ROWS, STEP_S, Floats, Numbers, Simulated, simulate

_HELD_OUT = 5
"""Every fifth piece is left out of the fit, and judges it"""
_LIMITS: Mapping[str, tuple[float, float, float]] = {
    "drive": (1.0, 1e-2, 1e5),
    "back_emf": (0.02, 1e-4, 50.0),
    "friction": (0.1, 0.0, 1e3),
    "load_friction": (0.02, 0.0, 0.8),
    "viscous_friction": (0.2, 0.0, 500.0),
    "stribeck_friction": (0.1, 0.0, 1e3),
    "stribeck_speed": (0.05, 0.02, 5.0),
    "gain": (0.05, 1e-3, 1e3),
    "delay": (2e-4, -0.01, 0.1),
    "gravity_sin": (0.2, -1e4, 1e4),
    "gravity_cos": (0.2, -1e4, 1e4),
    "resistance": (0.05, 1e-2, 1e4),
    "effort_delay": (2e-4, -0.02, 0.02),
}
"""Of each number a change that shows, by which derivatives are taken, and its bounds."""
_RELATIVE = frozenset(("drive", "back_emf", "gain", "resistance"))
"""Those whose change is a part of the start."""
_COULOMB = ("drive", "back_emf", "friction", "delay", "gravity_sin", "gravity_cos")
_ALIKE = 0.8
"""Correlation of measured and simulated effort, below which the measured one is something else"""
_SATURATED = 0.01
"""Part of the time at full duty from which on that tells how large a duty is"""
_SMOOTH_S = 0.06
_MORE_FRICTION = ("load_friction", "stribeck_friction")
_BETTER = 0.03
"""Part by which friction near standstill must lower the error in the pieces that were held out"""
_FAR = 0.15
"""Part of the whole way by which a servo never is off the simplest model"""
_LOOSE = 0.5
"""Part of the drive as its half-width, from which on nothing is determined"""
_EFFORT_S = 3e-3
"""s by which the time of an effort is uncertain: what it shows is of its control's last turn, and filtered"""
_TIMING_S = 1.5e-3
"""s by which all times of commands and positions may be wrong together, one standard deviation: turns of the
servo's own control, and what an adapter keeps [i]. More samples do not make it less."""


class Fit(msgspec.Struct, frozen=True):
    """The numbers that fit best."""

    friction_model: str
    """m1: Coulomb and viscous; m3: and load-dependent; m4: and Stribeck"""
    numbers: Numbers
    free: tuple[str, ...]
    """Those that were fitted; the others are as they were given"""
    covariance: Floats
    """Of `free`, shape (free, free)"""
    pieces: int
    """As many clusters as the intervals are from"""
    independent: float
    """As many independent residuals as those of the fit count for"""
    position_rms: float
    """rad, of measured minus simulated in the pieces that were fitted"""
    held_out_rms: float
    """rad, in those that were not"""
    effort_rms: float | None
    """Of the efforts, A or part of the full voltage; None: not used"""
    noise: tuple[float, float]
    """Standard deviations of what is left of positions and efforts, for a fit that begins here"""
    bic: float
    """Schwarz' criterion; comparable between fits of one run"""

    @property
    def student(self) -> float:
        """Half-widths of 95 % in standard deviations."""
        return float(stats.t.ppf(0.975, max(2, self.pieces - len(self.free))))

    def variance(self, name: str) -> float:
        """Return the variance of a number; 0 where it was given."""
        return (
            float(self.covariance[self.free.index(name), self.free.index(name)]) if name in self.free else 0.0
        )


class Curve(msgspec.Struct, frozen=True):
    """What was measured and what the model does, for a picture; shape (samples,)."""

    time_s: Floats
    measured: Floats
    simulated: Floats
    held_out: NDArray[np.bool_]


def fit_run(run: Measured) -> tuple[Fit, ...]:
    """Fit the model with more and more friction; the first is the one that the run bears out.

    Raises InputError with one sentence where the run does not determine the motor.
    """
    start = _start(run)
    noise = (max(run.servo.tick / np.sqrt(12), 3e-4), _first_effort_noise(run))
    coulomb = _fit(run, "m1", start, _free(run, start), noise)
    _require_followed(run, coulomb)
    coulomb = _fit(run, "m1", coulomb.numbers, coulomb.free, coulomb.noise)
    begin = replace(coulomb.numbers, load_friction=0.05)
    loaded = _fit(run, "m3", begin, (*coulomb.free, "load_friction"), coulomb.noise)
    begin = replace(loaded.numbers, stribeck_friction=0.2 * loaded.numbers.friction)
    free = (*loaded.free, "stribeck_friction", "stribeck_speed")
    sticking = _fit(run, "m4", begin, free, loaded.noise)
    fits = _judged((coulomb, loaded, sticking))
    _require_determined(run, fits[0])
    return fits


def curves(run: Measured, numbers: Numbers) -> tuple[Curve, Curve]:
    """Return positions and efforts in the run's order, and what the model makes of them."""
    parts = [(group, _simulated(group, numbers.array()[:, None])) for group in run.groups]
    order = np.argsort(np.concatenate([group.time_s for group in run.groups]), kind="stable")
    time_s = np.concatenate([group.time_s for group in run.groups])[order]
    held = np.concatenate([_held_out(group) for group in run.groups])[order]
    both = []
    for quantity in ("position", "effort"):
        measured = np.concatenate([getattr(group, quantity) for group, _ in parts])[order]
        simulated = np.concatenate(
            [
                _sampled(run, group, found, quantity, np.array([numbers.effort_delay]))[:, 0]
                for group, found in parts
            ]
        )[order]
        both.append(Curve(time_s, measured, simulated, held))
    return both[0], both[1]


# The start


def _start(run: Measured) -> Numbers:
    """Return the numbers of a linear least squares, or those of the built-in motor if they are nearer."""
    built_in = run.servo.built_in
    gain, _ = run.servo.expected_gain()
    voltage = built_in.voltage or 12.0
    resistance = voltage / max(1e-6, built_in.stall_torque / max(1e-6, built_in.torque_per_ampere))
    known = Numbers(
        drive=built_in.stall_torque / voltage / built_in.inertia,
        back_emf=built_in.damping * voltage / built_in.stall_torque,
        friction=built_in.friction / built_in.inertia,
        gain=gain or 5.0,
        delay=0.003,
        resistance=resistance,
    )
    candidates = [known, *(replace(known, **_linear(run, known, share)) for share in (1.0, 0.5))]
    costs = [_cost(run, numbers) for numbers in candidates]
    return candidates[int(np.argmin(costs))]


def _linear(run: Measured, known: Numbers, share: float) -> dict[str, float]:
    """Return drive, back-EMF, friction and gravity by a linear least squares on the smoothed motion."""
    period = float(np.median(np.diff(run.time_s)))
    window = max(5, round(_SMOOTH_S / period) | 1)
    even = np.arange(run.time_s[0], run.time_s[-1], period)
    position = np.interp(even, run.time_s, run.position)
    velocity = signal.savgol_filter(position, window, 3, deriv=1, delta=period)
    acceleration = signal.savgol_filter(position, window, 3, deriv=2, delta=period)
    at = np.minimum(np.searchsorted(run.time_s, even - known.delay), len(run.time_s) - 1)
    control = run.servo.control()
    error = run.command[at] - position - control.damping_s * velocity
    duty = np.where(run.by_position[at], known.gain * error, run.command[at])
    volts = np.clip(duty, -control.limit, control.limit) * np.interp(even, run.time_s, run.voltage)
    volts = signal.savgol_filter(volts, window, 3)
    moving = np.abs(velocity) > 0.15
    columns = np.stack((volts, -velocity, -np.sign(velocity), -np.sin(position), np.cos(position)), axis=1)
    if np.count_nonzero(moving) < 50:
        return {}
    least = np.array([1e-2, 1e-3, 0.0, -np.inf, -np.inf])
    found = optimize.lsq_linear(columns[moving], acceleration[moving], bounds=(least, np.full(5, np.inf))).x
    return {
        "drive": float(found[0]),
        "back_emf": max(1e-3, float(found[1] / found[0])),
        "friction": float(found[2]) * share,
        "gravity_sin": float(found[3]),
        "gravity_cos": float(found[4]),
    }


def _cost(run: Measured, numbers: Numbers) -> float:
    values = numbers.array()[:, None]
    return float(
        sum(
            np.sum(
                np.square(group.position - _sampled(run, group, _simulated(group, values), "position")[:, 0])
            )
            for group in run.groups
        )
    )


def _free(run: Measured, start: Numbers) -> tuple[str, ...]:
    """Return the numbers that the run can tell: the gain only where the size of a duty shows somewhere."""
    values = start.array()[:, None]
    duties = [np.abs(_simulated(group, values).duty) for group in run.groups]
    limit = run.groups[0].control.limit
    saturated = np.mean(np.concatenate([duty.ravel() for duty in duties]) >= 0.999 * limit) > _SATURATED
    shown = not run.servo.measures_current and _alike(run, start)
    by_duty = any(not group.control.by_position for group in run.groups)
    gain: tuple[str, ...] = ("gain",) if saturated or shown or by_duty else ()
    gain += ("effort_delay",) if shown else ()
    current = (
        ("resistance", "viscous_friction", "effort_delay")
        if run.servo.measures_current and _alike(run, start)
        else ()
    )
    return (*_COULOMB, *gain, *current)


def _alike(run: Measured, numbers: Numbers) -> bool:
    """Return whether the measured effort is what it is taken for."""
    _, effort = curves(run, numbers)
    known = np.isfinite(effort.measured)
    if np.count_nonzero(known) < 100 or np.ptp(effort.measured[known]) == 0.0:
        return False
    return bool(np.corrcoef(effort.measured[known], effort.simulated[known])[0, 1] > _ALIKE)


# The fit itself


def _fit(run: Measured, name: str, start: Numbers, free: Sequence[str], noise: tuple[float, float]) -> Fit:
    rows = [ROWS[each] for each in free]
    fixed = start.array()
    effort_used = "effort_delay" in free
    typical = np.array(
        [_LIMITS[each][0] * (abs(fixed[ROWS[each]]) if each in _RELATIVE else 1.0) for each in free]
    )
    typical = np.where(np.isin(free, list(_RELATIVE)), typical * 0.02, typical)
    bounds = tuple(np.array([_LIMITS[each][end] for each in free]) for end in (1, 2))
    x = np.clip(fixed[rows], bounds[0] + 1e-9, bounds[1] - 1e-9)

    def residuals(x: Floats, *, steps: Floats | None = None) -> Floats:
        """Return the residuals of x, or of x and x with each number changed; shape (samples, sets)."""
        sets = 1 if steps is None else len(x) + 1
        values = np.repeat(fixed[:, None], sets, axis=1)
        values[rows] = x[:, None]
        if steps is not None:
            values[rows, range(1, sets)] += steps
        parts = []
        for group in run.groups:
            found = _simulated(group, values)
            kept = ~_held_out(group)
            parts.append(
                ((group.position[:, None] - _sampled(run, group, found, "position")) / noise[0])[kept]
            )
            if effort_used:
                efforts = _sampled(run, group, found, "effort", values[ROWS["effort_delay"]])
                spread = np.hypot(noise[1], _EFFORT_S * group.effort_rate)
                parts.append(((group.effort[:, None] - efforts) / spread[:, None])[kept])
        return np.concatenate(parts)

    def jacobian(x: Floats) -> Floats:
        # inwards at a bound
        steps = np.where(x + typical / 10 < bounds[1], typical, -typical) / 10
        found = residuals(x, steps=steps)
        slopes: Floats = (found[:, 1:] - found[:, :1]) / steps
        return slopes

    result = optimize.least_squares(
        lambda x: residuals(x)[:, 0],
        x,
        jac=jacobian,
        bounds=bounds,
        x_scale=typical,
        xtol=1e-5,
        ftol=1e-5,
        max_nfev=40,
        loss="soft_l1",
        f_scale=3.0,
    )
    x = result.x
    values = fixed.copy()
    values[rows] = x
    numbers = Numbers.of(values)
    slopes, left = jacobian(x), residuals(x)[:, 0]
    clusters = _clusters(run, twice=effort_used)
    position, effort = curves(run, numbers)
    kept = ~position.held_out
    return Fit(
        friction_model=name,
        numbers=numbers,
        free=tuple(free),
        covariance=_sandwich(slopes, left, clusters) + _by_timing(slopes, free),
        pieces=len(np.unique(clusters)),
        independent=_independent(left, clusters),
        position_rms=_rms((position.measured - position.simulated)[kept]),
        held_out_rms=_rms((position.measured - position.simulated)[position.held_out]),
        effort_rms=_rms((effort.measured - effort.simulated)[kept]) if effort_used else None,
        noise=_noise(run, numbers, noise),
        bic=float("nan"),
    )


def _judged(fits: Sequence[Fit]) -> tuple[Fit, ...]:
    """Return fits with their BIC, that one first which has no more friction than the run bears out.

    More friction must lower the BIC (G. Schwarz, Annals of Statistics 6, 1978) of the positions, with as many
    residuals as are independent, and be told from 0. Friction near standstill must also lower the error in
    the pieces that were held out: of very many samples the rest takes each small fault of the model for it.
    """
    count = fits[-1].independent
    judged = [
        replace(fit, bic=float(count * np.log(fit.position_rms**2) + len(fit.free) * np.log(count)))
        for fit in fits
    ]
    best = judged[0]
    for fit, number, better in zip(judged[1:], _MORE_FRICTION, (0.0, _BETTER), strict=True):
        told = getattr(fit.numbers, number) > fit.student * np.sqrt(fit.variance(number))
        if told and fit.bic < best.bic and fit.held_out_rms < (1.0 - better) * best.held_out_rms:
            best = fit
    return (best, *(fit for fit in judged if fit is not best))


def _simulated(group: Compared, values: Floats) -> Simulated:
    return simulate(values, group.pieces, group.control)


def _sampled(
    run: Measured, group: Compared, found: Simulated, quantity: str, delays: Floats | None = None
) -> Floats:
    """Return positions, or efforts as the servo measures them, at the samples; shape (samples, sets).

    `delays`: s by which each set's effort is older than the position.
    """
    if quantity == "position":
        return _between(found.position, group, group.step, group.part)
    # a duty holds for its step, and is in its middle what a line between two of them is at a point
    values = found.current if run.servo.measures_current else found.duty
    delays = np.zeros(values.shape[1]) if delays is None else delays
    sampled = np.empty((len(group.step), values.shape[1]))
    for delay in np.unique(delays):
        sets = delays == delay
        along = np.clip(group.step + group.part - delay / STEP_S - 0.5, 0.0, group.pieces.steps - 1e-6)
        step = along.astype(np.intp)
        sampled[:, sets] = _between(values[:, sets], group, step, along - step)
    return sampled


def _between(values: Floats, group: Compared, step: NDArray[np.intp], part: Floats) -> Floats:
    before, after = values[step, :, group.piece], values[step + 1, :, group.piece]
    between: Floats = before + part[:, None] * (after - before)
    return between


def _held_out(group: Compared) -> NDArray[np.bool_]:
    held: NDArray[np.bool_] = group.piece % _HELD_OUT == _HELD_OUT - 1
    return held


def _first_effort_noise(run: Measured) -> float:
    efforts = np.concatenate([group.effort for group in run.groups])
    return max(1e-3, 0.05 * float(np.nanstd(efforts)))


def _noise(run: Measured, numbers: Numbers, before: tuple[float, float]) -> tuple[float, float]:
    """Return what is left of positions and of efforts, robustly, not less than positions in ticks explain.

    Efforts never count for more than at first: between their steps they are not what the model says.
    """
    found = []
    for curve, least in zip(curves(run, numbers), (run.servo.tick / np.sqrt(12), before[1]), strict=True):
        left = np.abs(curve.measured - curve.simulated)[~curve.held_out]
        found.append(max(least, 1.4826 * float(np.median(left))))
    return found[0], found[1]


def _clusters(run: Measured, *, twice: bool) -> NDArray[np.intp]:
    parts, first = [], 0
    for group in run.groups:
        mine = group.piece[~_held_out(group)] + first
        parts += [mine, mine] if twice else [mine]
        first += int(group.piece.max()) + 1
    return np.concatenate(parts)


def _sandwich(slopes: Floats, left: Floats, clusters: NDArray[np.intp]) -> Floats:
    """Return the covariance of a least squares whose residuals hang together within clusters."""
    # Huber's weights of the loss, as residuals of 3 and more count less
    weight = 1.0 / np.sqrt(1.0 + np.square(left / 3.0))
    scale = 1.0 / np.maximum(np.sqrt(np.sum(np.square(slopes), axis=0)), 1e-12)
    scaled = slopes * scale
    bread = np.linalg.pinv((scaled * weight[:, None]).T @ scaled, rcond=1e-14)
    information = (scaled * weight[:, None]).T @ scaled
    meat = np.zeros_like(information)
    names = np.unique(clusters)
    for name in names:
        mine = clusters == name
        slope, score = scaled[mine], (weight * left)[mine]
        own = (slope * weight[mine][:, None]).T @ slope
        # as the fit without this piece has it: a piece pulls the fit towards itself
        jackknifed = information @ np.linalg.pinv(information - own, rcond=1e-12) @ (slope.T @ score)
        meat += np.outer(jackknifed, jackknifed)
    part = (len(names) - 1) / len(names)
    covariance: Floats = part * bread @ meat @ bread * np.outer(scale, scale)
    return covariance


def _by_timing(slopes: Floats, free: Sequence[str]) -> Floats:
    """Return the covariance by a delay that is wrong: it moves the others as far as they can stand for it.

    In a smooth motion a larger gain looks like a shorter delay; where steps tell them apart this is small.
    """
    delay = free.index("delay")
    others = [each for each in range(len(free)) if each != delay]
    moved = np.zeros(len(free))
    moved[delay] = 1.0
    moved[others] = -np.linalg.lstsq(slopes[:, others], slopes[:, delay], rcond=None)[0]
    return np.outer(moved, moved) * _TIMING_S**2


def _independent(left: Floats, clusters: NDArray[np.intp]) -> float:
    """Return as how many independent residuals these count, by their correlation within clusters."""
    same = clusters[1:] == clusters[:-1]
    power = float(np.mean(np.square(left)))
    lag = float(np.mean((left[1:] * left[:-1])[same])) / power if power > 0 and same.any() else 0.0
    lag = min(0.999, max(0.0, lag))
    return max(10.0, len(left) * (1.0 - lag) / (1.0 + lag))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _require_followed(run: Measured, fit: Fit) -> None:
    """Raise InputError where a run is not that of a servo which follows these goals."""
    if fit.position_rms > _FAR * run.moved:
        raise InputError(
            f"{run.servo.joint}: no model of a servo follows this run ({fit.position_rms:.2g} of "
            f"{run.moved:.2g} rad off): something else moved the joint, its direction is wrong, or its "
            "goals are those of another one"
        )


def _require_determined(run: Measured, fit: Fit) -> None:
    """Raise InputError where not even the motor's drive is determined."""
    name = run.servo.joint
    part = fit.student * np.sqrt(fit.variance("drive")) / fit.numbers.drive
    if part > _LOOSE:
        raise InputError(
            f"{name}: this run does not determine its motor (the torque for a volt is known to {part:.0%} "
            f"only): it has too few accelerations; run `dxlrun identify {name}`"
        )
