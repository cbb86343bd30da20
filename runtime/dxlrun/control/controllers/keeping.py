"""Keeping: restore states that controllers kept in earlier runs, and publish new ones in pieces on /kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from zlib import crc32

import numpy as np

from dxlrun.channels.event_records import EventSink
from dxlrun.channels.kept import (
    MOST_KEPT,
    TOPIC,
    Facts,
    KeptPiece,
    KeptStates,
    difference,
    file_pieces,
)
from dxlrun.control import texts
from dxlrun.control.controllers.published_topics import Publisher, TopicLog
from dxlrun.control.controllers.update_order import Plans
from dxlrun.errors import ControllerFault
from dxlrun.messages import Header
from dxlrun.plan.loop_plan import ControllerPlan


class StateKeeper:
    """Restores the state that a controller kept in an earlier run, and publishes new ones piece by piece.

    A state whose publication has begun is completed. Of the states that a controller keeps during that time,
    only the newest is published.
    """

    def __init__(self, states: KeptStates, topics: TopicLog, events: EventSink) -> None:
        self._states = states
        self._topics = topics
        self._events = events
        self._publisher: Publisher | None = None
        self.controllers: dict[str, Facts] = {}
        """Facts (servos, controllers below) that each controller's kept state depends on, by controller.
        Empty: no controller keeps a state, and cycles skip `publish_next`."""
        self._waiting: dict[str, bytes] = {}
        """Kept states whose publication has not begun, by controller."""
        self._newest: dict[str, bytes] = {}
        """Last state that each controller kept in this run."""
        self._leaving: Iterator[bytes] = iter(())
        self._number = -1
        self._message = KeptPiece(Header(), "", 0, 0, 0, np.empty(0, np.uint8))

    def open_state(self, plan: ControllerPlan, plans: Plans) -> tuple[bytes, Callable[[bytes], None]]:
        """Return the state that a controller kept before, and the function by which it keeps a new one.

        The state is empty if none was kept, or if it does not fit this robot. The first call announces the
        topic /kept. Allocates.

        Args:
            plan: The controller.
            plans: Plans by name, including the controllers below this one.
        """
        if self._publisher is None:
            self._publisher = self._topics.open(TOPIC, KeptPiece)
        before, facts = self.controllers.get(plan.name), self._made_with(plan, plans)
        self.controllers[plan.name] = facts
        keep = partial(self._keep, plan.name)
        if before == facts and plan.name in self._newest:  # loaded again in this run
            return self._newest[plan.name], keep
        file = self._states.files.get(plan.name)
        if file is None:
            return b"", keep
        problem = file.problem or difference(file.made_with, facts)
        if problem:
            self._events.emit_event(plan.name, texts.kept_state_unusable(problem, file.place))
            return b"", keep
        self._events.emit_event(plan.name, texts.kept_state_used(len(file.state), file.place))
        return file.state, keep

    def _made_with(self, plan: ControllerPlan, plans: Plans) -> Facts:
        """Return the facts that a state depends on: the servos of its joints and the controllers below it."""
        facts = {"type": plan.type, "joints": ", ".join(plan.joints)}
        for joint in plan.joints:
            facts |= {f"{joint} {name}": fact for name, fact in self._states.servos.get(joint, {}).items()}
        lower = list(plan.into)
        for name in lower:  # the body appends to `lower`
            below = plans.get(name)
            if below is not None:
                facts[f"below: {name}"] = f"{below.type} {crc32(below.parameters.encode()):08x}"
                lower += [further for further in below.into if further not in lower]
        return facts

    def _keep(self, controller: str, state: bytes) -> None:
        """Store a state for publication. Raises ControllerFault for a wrong type or size."""
        if not isinstance(state, bytes):
            raise ControllerFault(f"returned {type(state).__name__} as its state to keep, not bytes")
        if len(state) > MOST_KEPT:
            raise ControllerFault(f"returned {len(state)} bytes as its state to keep, more than {MOST_KEPT}")
        self._waiting[controller] = self._newest[controller] = state

    def publish_next(self) -> None:
        """Publish the next piece of a kept state on /kept, if any. Called once a cycle."""
        if self._publisher is None:
            return
        data = next(self._leaving, None)
        if data is None:
            if not self._waiting:
                return
            data = self._begin_message()
        self._message.data = np.frombuffer(data, np.uint8)
        self._publisher.publish(self._message)
        self._message.piece += 1

    def _begin_message(self) -> bytes:
        controller = next(iter(self._waiting))
        state = self._waiting.pop(controller)
        self._number += 1
        message = self._message
        message.controller, message.state = controller, self._number
        message.piece = 0
        message.pieces, self._leaving = file_pieces(controller, state, self.controllers[controller])
        return next(self._leaving)

    def publish_remaining(self) -> None:
        """Publish all remaining pieces at the end of a run, after the controllers were deactivated."""
        while self._waiting or self._message.piece < self._message.pieces:
            self.publish_next()
