"""Loop: the control loop, which once a period reads servos, updates controllers, limits goals and writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, Protocol, cast, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.commands import LOOP, OWN_ORIGIN, TakenCommand
from dxlrun.channels.cycle import CycleRecord, Torque
from dxlrun.channels.event_records import CommandOutside, EventSink
from dxlrun.control import texts
from dxlrun.control.context import ControlContext
from dxlrun.control.controllers.activity import is_interrupt
from dxlrun.control.controllers.managed import PERIOD_CAP
from dxlrun.control.controllers.manager import Manager
from dxlrun.control.controllers.plugin_loading import OverrunHook
from dxlrun.control.gate import Gate
from dxlrun.control.monitors import build_monitors
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.control.safe_motion import SafeMotion
from dxlrun.control.sampled_sources import SourceReader
from dxlrun.control.steering import Steering
from dxlrun.errors import PortError
from dxlrun.plan.loop_plan import OverrunPolicy, ServoLimit
from dxlrun.plan.policy_plan import Last


class CycleSink(Protocol):
    """Destination of finished cycles, such as the log. Its methods never block and never raise."""

    def wake(self, cycle: int) -> None:
        """Note that a cycle starts: bus packets from now on belong to the period of this cycle."""

    def append_cycle(self, record: CycleRecord) -> None:
        """Store a copy of a finished cycle's record, whose memory the next cycle overwrites."""

    def append_activation(self, record: CycleRecord) -> None:
        """Store a copy of the record before the first cycle: states and goals of the activation."""


class LoopResult(msgspec.Struct, frozen=True):
    """Result of a finished loop. `cycles` + `skipped` is the number of elapsed periods."""

    cycles: int
    skipped: int
    reason: Literal["ended", "stopped", "fault"]
    detail: str = ""
    """Explanation in one sentence if the reason is a fault; may be empty otherwise."""
    last: Last = "limp"
    """Final state of the robot after the exit policy: `limp` or `hold`. The code that stops the hardware
    applies it."""
    invalid: tuple[int, ...] = ()
    """Number of cycles with an invalid servo state, a value for each joint. Requested reboots do not
    count."""
    paused: int = 0
    """Number of the elapsed periods in which the loop was paused."""
    outside: tuple[CommandOutside, ...] = ()


class ControlLoop:
    """Control loop of one robot.

    The code that builds the loop starts the hardware before and stops it after the loop. The Schedule decides
    when a cycle is due and has the controllers' time: the time of the wake-up since the first deadline,
    without pauses. Controllers also get the measured time since their last update, at most PERIOD_CAP
    periods. A cycle executes a bounded number of commands from the inbox after its read.
    """

    def __init__(
        self,
        context: ControlContext,
        manager: Manager,
        sink: CycleSink,
        *,
        overrun_hooks: tuple[OverrunHook, ...] = (),
        readers: tuple[SourceReader, ...] = (),
    ) -> None:
        """Build the loop with its gate, steering and monitors.

        Args:
            context: The run.
            manager: Controllers of the run. They may be configured later.
            sink: Destination of finished cycles.
            overrun_hooks: Hooks of plug-ins for late cycles.
            readers: Copy the samples of source processes into the record. A replay has none, because its
                record has the samples.
        """
        self.context = context
        self.manager = manager
        self.gate = Gate(context.plan, context.record, context.events)
        self.sink = sink
        self.readers = readers
        # Attributes that each cycle reads, bound here to save lookups.
        self.plan, self.record = context.plan, context.record
        self.clock, self.hardware = context.clock, context.hardware
        self._stop, self._beat = context.supervision.stop, context.supervision.beat
        self.schedule = context.schedule
        self._overruns = Overruns(context.plan.overrun, overrun_hooks, context.events)
        self._paused_cycles = 0
        self._woken_ns = 0
        self._cycles = 0
        joints = len(context.plan.joints)
        self._invalid: NDArray[np.int64] = np.zeros(joints, np.int64)
        """Number of cycles with an invalid servo state, by joint, without cycles of a requested reboot."""
        self._all_valid = bytes([True]) * joints
        self._skipped = 0
        self._late = False
        self._actions = PolicyActions(context, manager, self.gate)
        self._monitors = build_monitors(context.plan, context.record, self._actions)
        self.steering = Steering(context, manager, self.gate, self._actions)
        self._anchoring = self.steering.anchoring
        self._motion: SafeMotion | None = None
        self._servo_limits: Mapping[int, Sequence[ServoLimit]] = {}
        """Register limits of the servos that the gate has. Compared by identity: the hardware replaces the
        mapping when a servo returns."""

    def run(self) -> LoopResult:
        """Run cycles until the plan's end, a stop request or a fault, then execute the policy for that end.

        Controllers are activated before the first cycle and deactivated after the last one. The steps of the
        policy follow, and leave the robot limp or holding. Exceptions of controllers and PortError of the
        hardware become the result; other exceptions pass through.
        """
        self._activate_controllers()
        try:
            reason, detail = self._cycle_until_end()
        except PortError as error:
            reason, detail = "fault", str(error)
        finally:
            # The schedule already excludes the period that follows the last cycle of a pause.
            self.schedule.end_cycles(self.clock.now_ns())
            self.manager.deactivate()
            self.steering.answer_remaining()
        if reason != "fault" and self.manager.switching.fault is not None:
            reason, detail = "fault", self.manager.switching.fault
        policy = "on_fault" if reason == "fault" else "on_exit"
        if self._actions.ending:
            policy, sentence = self._actions.ending
            reason, detail = "fault", detail or sentence
        last = self._wind_up(policy)
        self._log_end(reason, detail)
        return LoopResult(
            self._cycles,
            self._skipped,
            reason,
            detail,
            last,
            tuple(self._invalid.tolist()),
            self._paused_cycles,
            self.gate.outside,
        )

    # Inside

    def _activate_controllers(self) -> None:
        """Start the schedule, log the start and activate controllers a period before the first deadline."""
        self._woken_ns = self.clock.now_ns()
        self.schedule.start_at(self._woken_ns)
        self.context.events.emit_event("loop", texts.loop_started(self.plan.period_ns))
        for reader in self.readers:
            reader.read_sources()
        self._take_servo_limits()
        self.gate.initialize_goals()
        self.gate.ease_in()
        self._log_start()
        self.manager.switching.start_controllers()

    def _take_servo_limits(self) -> None:
        self._servo_limits = self.hardware.servo_limits
        self.gate.take_servo_limits(self._servo_limits)

    def _cycle_until_end(self) -> tuple[Literal["ended", "stopped", "fault"], str]:
        """Run cycles; return the reason of the end (`ended`, `stopped`, `fault`) and a fault's sentence."""
        end_ns, schedule = self.plan.end_ns, self.schedule
        while self.manager.switching.fault is None:
            # A motion that ends late must not shorten the settling time of its goal.
            if end_ns is not None and schedule.grid_ns >= end_ns and not self.manager.settles:
                return "ended", ""
            if self.plan.ends_with_goals and self.manager.has_played:
                return "ended", ""
            if self._stop.requested:
                return "stopped", ""
            if self._actions.ending:
                return "fault", self._actions.ending[1]
            self._one()
            if self._next():
                what = f"cycle {self.record.cycle} ended after the next deadline"
                return "fault", f"{what} (`overrun: stop` in the robot file)"
        return "fault", self.manager.switching.fault

    def _one(self) -> None:
        """Run one cycle: wait, read servos, execute commands, update controllers, gate, write goals."""
        record, now_ns, schedule = self.record, self.clock.now_ns, self.schedule
        cycle, deadline_ns = schedule.cycle, schedule.due_ns
        self.hardware.idle(deadline_ns, schedule.grid_ns)
        woken_ns = self.clock.wait_until(deadline_ns)
        behind_ns = schedule.begin_cycle(woken_ns)
        dt_ns = min(woken_ns - self._woken_ns, PERIOD_CAP * schedule.period_ns)
        self._woken_ns = woken_ns
        record.wake(cycle, deadline_ns, woken_ns, dt_ns)
        self.sink.wake(cycle)
        steering, manager = self.steering, self.manager
        steering.stood = steering.paused_until_ns > 0
        if not manager.switching.modes_requested:
            manager.switching.request_modes()
        record.reset_counts()
        for provided in manager.providers:
            provided.grow_old(dt_ns)
        if self._motion:
            self._motion.request_modes()
        self.hardware.read_states()
        for reader in self.readers:
            reader.read_sources()
        read_ns = now_ns()
        if self.hardware.servo_limits is not self._servo_limits:
            self._take_servo_limits()
        if record.states.mode.tobytes() != self.gate.modes:
            self.gate.enter_modes()
        # For some twenty joints, a search in bytes takes less than a tenth of the time of a numpy reduction.
        if Torque.GIVEN in record.states.torque.tobytes():
            self._anchoring.anchor_given()
        valid = record.states.valid
        all_valid = valid.tobytes() == self._all_valid
        if self._motion:
            steering.refuse_commands()
            self._motion.command()
        else:
            self._update(cycle, behind_ns)
        self.gate.move_goals(dt_ns)
        updated_ns = now_ns()
        self.hardware.write_goals()
        record.set_times(read_ns, updated_ns, now_ns())
        self.sink.append_cycle(record)
        self._cycles += 1
        if not all_valid:
            self._invalid += ~valid & (record.states.torque != Torque.REBOOTING)
        self._beat()

    def _update(self, cycle: int, behind_ns: int) -> None:
        """Run the monitors, execute commands, and update the controllers unless the loop is paused."""
        record, steering, manager = self.record, self.steering, self.manager
        if behind_ns > 0:  # after a pause that began in a late cycle, time must not go back
            self.schedule.grid_ns += behind_ns
        time_ns = self.schedule.time_ns
        for monitor in self._monitors:
            try:
                monitor.check_cycle(time_ns)
            except PortError:
                raise
            except (Exception, SystemExit) as error:  # foreign code: the run ends by the steps of its policy
                name, module, kind = type(monitor).__name__, type(monitor).__module__, type(error).__name__
                self._actions.end_run("on_fault", f"the monitor {name} of {module} raised {kind}: {error}")
        commands = steering.inbox.drain_commands()
        if commands or steering.paused_until_ns or steering.halt.waiting or manager.streams:
            record.command_count = steering.execute_commands(commands)
        if steering.paused_until_ns:
            record.commands.clear()
        else:
            manager.update(cycle - self._paused_cycles)
        if manager.switching.ended or steering.planned:
            steering.answer_late()

    def _wind_up(self, name: str) -> Last:
        """Execute the steps of an exit policy in additional cycles; return the final state, limp or hold."""
        policy = self.plan.policies.named(name)
        # After a fault, torque off does not wait for registers.
        stand_ns = self.manager.registers.time_left_ns if name == "on_exit" else 0
        motion = SafeMotion(policy, self.context, stand_ns)
        if not motion.over:
            self._log_policy(name, policy.text)
            if self.steering.paused_until_ns:
                self.steering.resume_controllers()
            self._motion = motion
            try:
                while not motion.over:
                    self._one()
                    self._next()
            except PortError as error:
                motion.give_up(str(error))
            if motion.unfinished:
                unfinished = texts.policy_unfinished(name, motion.unfinished, policy.last)
                self.context.events.emit_event("loop", unfinished)
        if policy.last == "hold":
            self.context.events.emit_event("loop", texts.policy_keeps_torque(name))
        return policy.last

    def _log_policy(self, name: str, text: str) -> None:
        self.context.events.emit_event("loop", texts.policy_begins(name, text))
        data = f'{{"policy":"{name}"}}'.encode()
        begun = TakenCommand(self.record.woken_ns, self.schedule.cycle, -1, LOOP, "policy", OWN_ORIGIN, data)
        self.context.command_log.record_command(begun)

    def _next(self) -> bool:
        """Advance the schedule past skipped periods to the next cycle.

        Returns True if an overrun ends the run.
        """
        schedule, cycle, due_ns = self.schedule, self.schedule.cycle, self.schedule.due_ns
        now_ns, policy, next_ns = self.clock.now_ns(), self.plan.overrun, due_ns + schedule.period_ns
        if self.steering.stood:
            policy = "skip" if policy == "stop" else policy  # cycles of a pause may be long
        elif now_ns <= next_ns:
            schedule.advance_to_cycle(cycle + 1)
            self.record.skipped, self._late = 0, False
            return False
        else:
            policy = self._overruns.choose_policy(cycle + 1, next_ns, now_ns)
        following = schedule.following(now_ns, policy)
        if self.plan.end_ns is not None and not self._motion and not self.steering.stood:
            # Periods after the end of the plan do not count as skipped.
            left_ns = self.plan.end_ns - schedule.grid_ns
            following = min(following, cycle + max(1, -(-left_ns // schedule.period_ns)))
        skipped = following - cycle - 1
        if self.steering.stood:
            still = following - cycle if self.steering.paused_until_ns else skipped
            self._paused_cycles += still
            schedule.grid_ns -= still * schedule.period_ns
        schedule.advance_to_cycle(following)
        self.record.skipped = skipped
        self._skipped += skipped
        late = bool(skipped) or (policy == "catch_up" and now_ns > next_ns)
        if late and not self._late:
            overrun = texts.cycle_overran(cycle, now_ns - due_ns, skipped, policy == "catch_up")
            self.context.events.emit_event("loop", overrun)
        self._late = late
        return bool(skipped) and policy == "stop"

    def _log_start(self) -> None:
        record = self.record
        record.cycle = -1
        record.scheduled_ns = self.schedule.due_ns
        record.read_ns = record.updated_ns = record.written_ns = self.clock.now_ns()
        record.woken_ns = self._woken_ns  # a replay derives the first deadline from this time
        self.sink.append_activation(record)

    def _log_end(self, reason: str, detail: str) -> None:
        if reason == "fault":
            event = texts.loop_failed(self._cycles, self._skipped, detail)
        else:
            event = texts.loop_stopped(reason, self._cycles, self._skipped, detail)
        self.context.events.emit_event("loop", event)


class Overruns:
    """Selects the policy for a late cycle: a hook's first answer, otherwise `overrun` of the robot file.

    A hook that raises or returns an invalid answer is reported in an event and not called again.
    """

    def __init__(self, policy: OverrunPolicy, hooks: tuple[OverrunHook, ...], events: EventSink) -> None:
        self._policy = policy
        self._hooks = list(hooks)
        self._events = events

    def choose_policy(self, cycle: int, scheduled_ns: int, actual_ns: int) -> OverrunPolicy:
        """Return the policy for a cycle that was due at `scheduled_ns` but can begin only at `actual_ns`."""
        for hook in tuple(self._hooks):
            try:
                answer = hook.decide(cycle, scheduled_ns, actual_ns)
            except BaseException as error:  # foreign code must not end the loop
                if is_interrupt(error):
                    raise
                self._dismiss(hook, f"raised {type(error).__name__}: {error}")
                continue
            if answer is None:
                continue
            if isinstance(answer, str) and answer in get_args(OverrunPolicy):
                return cast("OverrunPolicy", answer)
            self._dismiss(hook, f"returned {answer!r}, not one of {', '.join(get_args(OverrunPolicy))}")
        return self._policy

    def _dismiss(self, hook: OverrunHook, why: str) -> None:
        self._hooks.remove(hook)
        self._events.emit_event(hook.plugin, texts.overrun_hook_dismissed(why))
