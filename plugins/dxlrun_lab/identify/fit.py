"""Fit: parameters of the servo model (model.py) with which its simulation is closest to the measured motion.

The method is output error. Each piece of the run is simulated from its commands alone, and positions (and
currents, or duties) are compared with the measured ones. A linear least squares fit on smoothed accelerations
provides the start.

Confidence intervals are linearised and account for correlated residuals. The covariance is the sandwich
estimator of K.-Y. Liang and S. L. Zeger, "Longitudinal data analysis using generalized linear models"
(Biometrika 73, 1986), with pieces of one second as clusters. They are few, so the estimator is jackknifed
(R. M. Bell and D. F. McCaffrey, Survey Methodology 28, 2002) and Student's t is used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from scipy import optimize, signal, stats

from dxlrun import InputError
from dxlrun_lab.identify.joint_recording import JointRecording, ModeComparison
from dxlrun_lab.identify.model import ROWS, STEP_S, Floats, Numbers, SimulatedPieces, simulate

_HELD_OUT = 5
"""Every fifth piece is held out of the fit for its validation"""
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
"""Step for numerical derivatives, lower bound and upper bound of each parameter of Numbers"""
_RELATIVE = frozenset(("drive", "back_emf", "gain", "resistance"))
"""Parameters whose step is relative to their start value"""
_COULOMB = ("drive", "back_emf", "friction", "delay", "gravity_sin", "gravity_cos")
_ALIKE = 0.8
"""Correlation of measured and simulated effort below which measured efforts are ignored"""
_SATURATED = 0.01
"""Fraction of the time at full duty above which the servo's gain can be identified"""
_SMOOTH_S = 0.06
_MORE_FRICTION = ("load_friction", "stribeck_friction")
_BETTER = 0.03
"""Relative reduction of the error in held-out pieces that friction near standstill must achieve"""
_FAR = 0.15
"""Error of the simplest model, as a fraction of the travel, above which the joint did not follow its goals"""
_LOOSE = 0.5
"""Relative half-width of the interval of `drive` above which the run does not determine the motor"""
_EFFORT_S = 3e-3
"""Uncertainty of the time of an effort, s. It is filtered, and from the last period of the servo's control.
"""
_TIMING_S = 1.5e-3
"""Common error of all times of commands and positions, s, one standard deviation: period of the servo's
control and delay of the adapter [i]. More samples do not reduce it."""


class Fit(msgspec.Struct, frozen=True):
    """Fit of the servo model with one friction model to a run: parameters, covariance and errors"""

    friction_model: str
    """m1: Coulomb and viscous; m3: and load-dependent; m4: and Stribeck"""
    numbers: Numbers
    free: tuple[str, ...]
    """Names of the fitted parameters. All others have given values."""
    covariance: Floats
    """Covariance of the parameters in `free`, shape (free, free)"""
    pieces: int
    """Number of clusters of the confidence intervals"""
    independent: float
    """Effective number of independent residuals"""
    position_rms: float
    """Root mean square position error in the fitted pieces, rad"""
    held_out_rms: float
    """Root mean square position error in the held-out pieces, rad"""
    effort_rms: float | None
    """Root mean square error of the efforts, A or fraction of full voltage; None if not used"""
    noise: tuple[float, float]
    """Standard deviations of the residuals of positions and efforts, for the next fit"""
    bic: float
    """Schwarz' criterion; comparable between fits of one run"""

    @property
    def student(self) -> float:
        """Half-width of a parameter's 95 % interval in standard deviations (Student's t)"""
        return float(stats.t.ppf(0.975, max(2, self.pieces - len(self.free))))

    def variance(self, name: str) -> float:
        """Return the variance of a parameter, or 0 if it was given."""
        return (
            float(self.covariance[self.free.index(name), self.free.index(name)]) if name in self.free else 0.0
        )


class FitCurve(msgspec.Struct, frozen=True):
    """Measured and simulated positions (rad) or efforts (A, or fraction of full voltage); shape (samples,)"""

    time_s: Floats
    """Time in the run, s, increasing"""
    measured: Floats
    simulated: Floats
    held_out: NDArray[np.bool_]
    """True for samples that validate the fit instead of determining it"""


def fit_run(run: JointRecording) -> tuple[Fit, ...]:
    """Fit the servo model with three friction models to a run, and return the selected fit first.

    Raises:
        InputError: The run does not determine the motor, or the joint did not follow its goals.
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


def curves(run: JointRecording, numbers: Numbers) -> tuple[FitCurve, FitCurve]:
    """Return two curves of a run: positions and efforts, measured and simulated with these parameters."""
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
        both.append(FitCurve(time_s, measured, simulated, held))
    return both[0], both[1]


# The start


def _start(run: JointRecording) -> Numbers:
    """Return the start values of the fit: those of the simulation's motor, or of a linear fit if better."""
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


def _linear(run: JointRecording, known: Numbers, share: float) -> dict[str, float]:
    """Fit drive, back-EMF, friction and gravity by linear least squares to the smoothed motion of a run.
    Returns parameters by name, with the friction times `share`; none if the joint hardly moved."""
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


def _cost(run: JointRecording, numbers: Numbers) -> float:
    values = numbers.array()[:, None]
    return float(
        sum(
            np.sum(
                np.square(group.position - _sampled(run, group, _simulated(group, values), "position")[:, 0])
            )
            for group in run.groups
        )
    )


def _free(run: JointRecording, start: Numbers) -> tuple[str, ...]:
    """Return the names of the parameters that the run determines and the fit varies. The gain needs a
    saturated duty, a measured duty or duty commands; resistance needs a measured current."""
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


def _alike(run: JointRecording, numbers: Numbers) -> bool:
    """Return True if the measured effort correlates with the simulated one, so that it can be fitted."""
    _, effort = curves(run, numbers)
    known = np.isfinite(effort.measured)
    if np.count_nonzero(known) < 100 or np.ptp(effort.measured[known]) == 0.0:
        return False
    return bool(np.corrcoef(effort.measured[known], effort.simulated[known])[0, 1] > _ALIKE)


# The fit itself


def _fit(
    run: JointRecording, name: str, start: Numbers, free: Sequence[str], noise: tuple[float, float]
) -> Fit:
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
        """Return the residuals of x, and of x with a step in each parameter; shape (samples, sets)."""
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
        # Step inwards at a bound.
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
    numbers = Numbers.from_array(values)
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
    """Return the fits with their BIC, the selected one first.

    Additional friction must lower the BIC (G. Schwarz, Annals of Statistics 6, 1978) of the positions,
    computed with the effective number of residuals, and differ significantly from 0. Friction near standstill
    must also lower the error in held-out pieces, because with many samples it would otherwise fit any error
    of the model.
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


def _simulated(group: ModeComparison, values: Floats) -> SimulatedPieces:
    return simulate(values, group.pieces, group.control)


def _sampled(
    run: JointRecording,
    group: ModeComparison,
    found: SimulatedPieces,
    quantity: str,
    delays: Floats | None = None,
) -> Floats:
    """Return simulated positions or efforts (`quantity`) at the times of the samples, shape (samples, sets).
    A set is one set of parameters; `delays` is the age of its effort relative to the position, s."""
    if quantity == "position":
        return _between(found.position, group, group.step, group.part)
    # A duty holds for a whole step, so the interpolation is shifted by half a step.
    values = found.current if run.servo.measures_current else found.duty
    delays = np.zeros(values.shape[1]) if delays is None else delays
    sampled = np.empty((len(group.step), values.shape[1]))
    for delay in np.unique(delays):
        sets = delays == delay
        along = np.clip(group.step + group.part - delay / STEP_S - 0.5, 0.0, group.pieces.steps - 1e-6)
        step = along.astype(np.intp)
        sampled[:, sets] = _between(values[:, sets], group, step, along - step)
    return sampled


def _between(values: Floats, group: ModeComparison, step: NDArray[np.intp], part: Floats) -> Floats:
    before, after = values[step, :, group.piece], values[step + 1, :, group.piece]
    between: Floats = before + part[:, None] * (after - before)
    return between


def _held_out(group: ModeComparison) -> NDArray[np.bool_]:
    held: NDArray[np.bool_] = group.piece % _HELD_OUT == _HELD_OUT - 1
    return held


def _first_effort_noise(run: JointRecording) -> float:
    efforts = np.concatenate([group.effort for group in run.groups])
    return max(1e-3, 0.05 * float(np.nanstd(efforts)))


def _noise(run: JointRecording, numbers: Numbers, before: tuple[float, float]) -> tuple[float, float]:
    """Return robust standard deviations of the residuals of positions (rad) and efforts, for the next fit.
    They are at least the quantisation noise of positions, and the initial noise of efforts."""
    found = []
    for curve, least in zip(curves(run, numbers), (run.servo.tick / np.sqrt(12), before[1]), strict=True):
        left = np.abs(curve.measured - curve.simulated)[~curve.held_out]
        found.append(max(least, 1.4826 * float(np.median(left))))
    return found[0], found[1]


def _clusters(run: JointRecording, *, twice: bool) -> NDArray[np.intp]:
    parts, first = [], 0
    for group in run.groups:
        mine = group.piece[~_held_out(group)] + first
        parts += [mine, mine] if twice else [mine]
        first += int(group.piece.max()) + 1
    return np.concatenate(parts)


def _sandwich(slopes: Floats, left: Floats, clusters: NDArray[np.intp]) -> Floats:
    """Return the covariance of the parameters of a least squares fit, robust to correlation within clusters.

    Args:
        slopes: Derivatives of the residuals, shape (residuals, parameters).
        left: Residuals.
        clusters: Number of the cluster of each residual.
    """
    # Weights of the soft L1 loss, which reduce the influence of residuals above 3.
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
        # Use the residuals of the fit without this piece, because a piece pulls the fit towards itself.
        jackknifed = information @ np.linalg.pinv(information - own, rcond=1e-12) @ (slope.T @ score)
        meat += np.outer(jackknifed, jackknifed)
    part = (len(names) - 1) / len(names)
    covariance: Floats = part * bread @ meat @ bread * np.outer(scale, scale)
    return covariance


def _by_timing(slopes: Floats, free: Sequence[str]) -> Floats:
    """Return the covariance of the parameters by an error of _TIMING_S in all times. In a smooth motion, a
    larger gain looks like a shorter delay. Steps in the motion separate them."""
    delay = free.index("delay")
    others = [each for each in range(len(free)) if each != delay]
    moved = np.zeros(len(free))
    moved[delay] = 1.0
    moved[others] = -np.linalg.lstsq(slopes[:, others], slopes[:, delay], rcond=None)[0]
    return np.outer(moved, moved) * _TIMING_S**2


def _independent(left: Floats, clusters: NDArray[np.intp]) -> float:
    """Return the effective number of independent residuals, from their correlation within clusters."""
    same = clusters[1:] == clusters[:-1]
    power = float(np.mean(np.square(left)))
    lag = float(np.mean((left[1:] * left[:-1])[same])) / power if power > 0 and same.any() else 0.0
    lag = min(0.999, max(0.0, lag))
    return max(10.0, len(left) * (1.0 - lag) / (1.0 + lag))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _require_followed(run: JointRecording, fit: Fit) -> None:
    """Raise InputError if the simplest model fits so badly that the joint did not follow its goals."""
    if fit.position_rms > _FAR * run.moved:
        raise InputError(
            f"{run.servo.joint}: no servo model fits this run (error {fit.position_rms:.2g} rad, motion "
            f"{run.moved:.2g} rad); check for an external force, a wrong direction, or goals of another joint"
        )


def _require_determined(run: JointRecording, fit: Fit) -> None:
    """Raise InputError if the 95 % interval of `drive` (acceleration per volt) is too wide."""
    name = run.servo.joint
    part = fit.student * np.sqrt(fit.variance("drive")) / fit.numbers.drive
    if part > _LOOSE:
        raise InputError(
            f"{name}: this run has too few accelerations (torque per volt known to {part:.0%} only); "
            f"run `dxlrun identify {name}`"
        )
