"""Prepared commands: arrays that `prepare` makes again from logged requests, compared with the log.

`prepare` ran outside of the loop: at compilation for a planned command, in the gateway for the command of a
client.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np
from msgspec import structs
from msgspec.structs import replace
from pydantic import ValidationError

from dxlrun import Controller, ParametersModel
from dxlrun.tooling.logs import UNREADABLE
from dxlrun.tooling.output import counted
from dxlrun.tooling.plans import LoopPlan, ScheduledCommand
from dxlrun.tooling.records import Play, TakenCommand
from dxlrun.tooling.robots import PlugIns
from dxlrun_analysis.replay.comparison import shown_bits
from dxlrun_analysis.replay.recorded_inputs import RecordedInputs, ReplayDifference

_LONGEST_REASON = 200  # Characters


class PreparedComparison:
    """Prepares the commands of a log again and compares each array with the recorded one bit by bit.

    The replay executes the new arrays. A command without a request in the log is executed as recorded.
    """

    def __init__(self, inputs: RecordedInputs) -> None:
        self._inputs = inputs
        self.first: ReplayDifference | None = None
        self.compared = 0
        self.different = 0
        self.without_request = 0  # Commands whose request is not in the log
        self._parameters: dict[str, list[ParametersModel]] = {}
        """All parameters that each controller has had so far. A client's command may have been prepared
        shortly before a change of parameters."""

    def of_plan(self, plan: LoopPlan, plugins: PlugIns) -> LoopPlan:
        """Return the plan with the data of its commands prepared again."""
        cycles = [one.cycle for one in self._inputs.log.commands if one.planned >= 0]
        known: dict[str, tuple[type[Controller[Any]], ParametersModel]] = {}
        for one in plan.controllers:
            offer = plugins.controllers.get(one.type)
            if offer is None:
                continue  # The manager reports a missing type, and parameters that do not fit
            with suppress(Exception):
                model = offer.controller.Parameters
                known[one.name] = offer.controller, model.model_validate_json(one.parameters)
        commands: list[ScheduledCommand] = []
        for command, cycle in zip(plan.commands, cycles, strict=False):
            data = command.data
            if command.controller in known:
                cls, parameters = known[command.controller]
                request = command.request.encode()
                data = self._again(cls, [parameters], command.controller, command.kind, request, data, cycle)
            commands.append(replace(command, data=data))
        return replace(plan, commands=(*commands, *plan.commands[len(commands) :]))

    def of_client(self, taken: TakenCommand, controller_of: Callable[[str], Controller[Any] | None]) -> bytes:
        """Return the data of a client's command, prepared again.

        Args:
            taken: The command as the loop executed it.
            controller_of: Function that returns a controller in its current state.
        """
        if not taken.for_loop:
            return self._one(taken, taken.controller, taken.kind, taken.request, taken.data, controller_of)
        if taken.kind != "play":
            return taken.data
        head, _, numbers = taken.data.partition(b"\n")
        try:
            parts = msgspec.json.decode(head, type=Play).parts
            requests = [json.dumps(one).encode() for one in json.loads(taken.request or b"[]")]
        except UNREADABLE:
            return taken.data  # The loop refuses the command, as in the run
        sizes = [size for part in parts for size in part.sizes]
        if 8 * sum(sizes) != len(numbers) or min(sizes, default=0) < 0:
            return taken.data
        ends = np.cumsum([0, *sizes]) * 8
        arrays = [numbers[begin:end] for begin, end in itertools.pairwise(ends.tolist())]
        requests += [b""] * (len(arrays) - len(requests))
        again: list[bytes] = []
        played = []
        for part in parts:
            own = range(len(again), len(again) + len(part.sizes))
            made = [
                self._one(taken, part.controller, part.kind, requests[at], arrays[at], controller_of)
                for at in own
            ]
            again += made
            played.append(structs.replace(part, sizes=tuple(len(one) // 8 for one in made)))
        return msgspec.json.encode(Play(tuple(played))) + b"\n" + b"".join(again)

    def _one(  # noqa: PLR0917  a command's parts, as they come
        self,
        taken: TakenCommand,
        name: str,
        kind: str,
        request: bytes,
        data: bytes,
        controller_of: Callable[[str], Controller[Any] | None],
    ) -> bytes:
        controller = controller_of(name)
        if controller is None or kind not in controller.Commands:
            return data  # The command is refused, as in the run
        seen = self._parameters.setdefault(name, [])
        if not seen or seen[-1] is not controller.parameters:
            seen.append(controller.parameters)
        return self._again(type(controller), seen, name, kind, request, data, taken.cycle)

    def _again(  # noqa: PLR0917  a command's parts, as they come
        self,
        cls: type[Controller[Any]],
        parameters: Sequence[ParametersModel],
        name: str,
        kind: str,
        request: bytes,
        recorded: bytes,
        cycle: int,
    ) -> bytes:
        """Prepare a request again and compare it with the recorded array; return the array for the replay."""
        if not request:
            self.without_request += 1
            return recorded
        self.compared += 1
        made: bytes | str = ""
        for one in reversed(parameters):
            now = _prepared(cls, one, kind, request)
            if now == recorded:
                return recorded
            made = made or now
        self.different += 1
        # The commands of the plan are prepared before all others, also those of later cycles.
        if self.first is None or cycle < self.first.cycle:
            numbers = self._inputs.log.cycles["cycle"]
            index = min(int(np.searchsorted(numbers, cycle)), len(numbers) - 1)
            what, then, now = _where(kind, recorded, made)
            self.first = self._inputs.difference(index, what, None, name, then, now)
        return recorded if isinstance(made, str) else made


def _prepared(
    cls: type[Controller[Any]], parameters: ParametersModel, kind: str, request: bytes
) -> bytes | str:
    """Return the array that `prepare` makes of a request, as little-endian float64 bytes, or the reason of
    its failure as text."""
    try:
        command = cls.Commands[kind].model_validate_json(request)
        return np.ascontiguousarray(cls.prepare(kind, command, parameters), dtype="<f8").tobytes()
    except ValidationError as error:
        reason = str(error.errors(include_url=False)[0]["msg"])
    # Foreign code can raise anything; one sentence replaces its traceback.
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {error}"
    return f"no array ({' '.join(reason.split())[:_LONGEST_REASON]})"


def _where(kind: str, recorded: bytes, replayed: bytes | str) -> tuple[str, str, str]:
    """Return the place of the first element that differs, and its recorded and replayed value, as text."""
    what = f"prepared array of command {kind}"
    then = np.frombuffer(recorded[: len(recorded) // 8 * 8], "<u8")
    if isinstance(replayed, str):
        return what, counted(len(then), "number", "numbers"), replayed
    now = np.frombuffer(replayed, "<u8")
    least = min(len(then), len(now))
    differing = np.flatnonzero(then[:least] != now[:least])
    if not len(differing):
        return what, counted(len(then), "number", "numbers"), counted(len(now), "number", "numbers")
    at = int(differing[0])
    place = f"{what}, element {at} of {len(then)}"
    return place, shown_bits(int(then[at])), shown_bits(int(now[at]))
