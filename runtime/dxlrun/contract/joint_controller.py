"""JointController: base class of short controllers with annotated fields and one method."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, cast, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import Field, create_model
from pydantic.errors import PydanticUserError

from dxlrun.channels.cycle import Floats
from dxlrun.contract.controller import LIVE, Context, Controller, Interfaces
from dxlrun.description.base_form import ParametersModel
from dxlrun.errors import ControllerFault, counted
from dxlwire.modes import CommandName

LAWS: dict[str, CommandName] = {"positions": "position", "velocities": "velocity", "efforts": "effort"}
"""Methods of a JointController with the command interface that each method claims."""
_MOST_SHOWN = 60  # characters of a wrong value in a message
_TAKEN = ("start", "context", "parameters", "type", "active", "rate", "fallback", "into")
"""Names that are not allowed for fields: attributes of controllers, and keys of their entries."""


class _Reading(str):
    """Default of a field that `reading` created: the name of its interface."""

    __slots__ = ()


def reading(interface: str = "") -> float:
    """Declare a field of a JointController with the value of an interface: `reading("imu/orientation.y")`.

    The interface is a state of a sensor, a device, another controller or another joint, named as in
    `Interfaces.reads`. The controller begins as soon as the value is known.

    Args:
        interface: Default name. The robot file may have another one; if empty, it must have one.
    """
    # `__init_subclass__` replaces this marker with a property that returns a float.
    return cast("float", _Reading(interface))


class JointParameters(ParametersModel):
    """Keys of all JointControllers."""

    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    """Joints that it moves, in the order of its arrays."""


class JointController(Controller[JointParameters]):
    """Base class of controllers that are formulas for the commands of some joints.

    Example:

        class Wave(JointController):
            amplitude: Angle = 0.3
            frequency: Frequency = 0.5

            def positions(self, time, dt):  # s since it began, s since the last call
                return self.start + self.amplitude * np.sin(2 * np.pi * self.frequency * time)

    Annotated fields are keys of its entry in the robot file, in addition to `joints`. Numbers and bools can
    be changed in a run. The methods return one number a joint: `positions` (rad or m), `velocities` (rad/s or
    m/s; together with `positions`, magnitudes of the speeds toward these) and `efforts` (unit of the state's
    effort). The controller claims the interfaces whose methods it implements.
    """

    Parameters: ClassVar[type[JointParameters]] = JointParameters
    start: Floats
    """Positions of its joints when it began: the last goals, or the measured positions without goals."""
    _readings: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls) -> None:
        """Convert the annotated fields to parameters. Raises TypeError for an invalid field."""
        super().__init_subclass__()
        fields: dict[str, Any] = dict(_fields(cls))
        read = [name for name in fields if isinstance(vars(cls).get(name), _Reading)]
        cls._readings = (*cls._readings, *read)
        base = cls.Parameters
        cls.Parameters = create_model(f"{cls.__name__}Parameters", __base__=base, **fields)
        for name in fields:
            setattr(cls, name, _shown(name, cls._readings.index(name) if name in read else None))

    @classmethod
    def interfaces(cls, parameters: JointParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the interfaces of its joints whose methods are implemented."""
        command = tuple(LAWS[name] for name in laws_of(cls))
        return Interfaces(
            parameters.joints, command, reads=tuple(getattr(parameters, name) for name in cls._readings)
        )

    def begin(self) -> None:
        """Initialize state that is kept from cycle to cycle.

        Called after each activation, as soon as all inputs are known.
        """

    def positions(self, time: float, dt: float) -> Floats:
        """Return a position for each joint, rad or m.

        Args:
            time: Time since the controller began, s.
            dt: Time since the last call, s.
        """
        raise NotImplementedError

    def velocities(self, time: float, dt: float) -> Floats:
        """Return a velocity for each joint."""
        raise NotImplementedError

    def efforts(self, time: float, dt: float) -> Floats:
        """Return an effort for each joint."""
        raise NotImplementedError

    @property
    def position(self) -> Floats:
        """Measured positions of its joints, rad or m, read-only; NaN before the first read."""
        return self.context.states.position

    @property
    def velocity(self) -> Floats:
        """Measured velocities, as `position`."""
        return self.context.states.velocity

    @property
    def effort(self) -> Floats:
        """Measured efforts, as `position`."""
        return self.context.states.effort

    def on_configure(self, context: Context) -> None:
        """Bind each method to the array that it commands."""
        super().on_configure(context)
        laws, commands = type(self), context.commands
        self._began_ns, self._first = -1, True
        self._laws = tuple(
            (name, getattr(laws, name), getattr(commands, LAWS[name])) for name in laws_of(laws)
        )

    def on_activate(self, time_ns: int) -> None:
        """Reset the time, and begin if all inputs are known."""
        self._began_ns = -1
        self._begin_when_known(time_ns)

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command the values of its methods. Raises ControllerFault unless they are one number a joint."""
        if self._began_ns < 0 and not self._begin_when_known(time_ns):
            return  # without commands, the joints hold
        time, dt = (time_ns - self._began_ns) * 1e-9, period_ns * 1e-9
        for name, law, command in self._laws:
            values = _one_a_joint(law(self, time, dt), name, self.context.joints)
            if self._first and np.isnan(values).any():  # later NaN is a fault for every controller
                joint = self.context.joints[int(np.argmax(np.isnan(values)))]
                raise ControllerFault(f"returned NaN for {joint} from {name}; return a number")
            command[:] = values
        self._first = False

    def _begin_when_known(self, time_ns: int) -> bool:
        """Begin if the positions of its joints and all readings are known; return whether it has begun."""
        sent, measured = self.context.goals.position, self.context.states.position
        self.start = np.where(np.isnan(sent), measured, sent)
        if np.isnan(self.start).any() or np.isnan(self.context.reads).any():
            return False
        self._began_ns, self._first = time_ns, True
        self.begin()
        return True


def laws_of(controller: type[JointController]) -> tuple[str, ...]:
    """Return the methods of `LAWS` that a class implements."""
    return tuple(name for name in LAWS if getattr(controller, name) is not getattr(JointController, name))


def _one_a_joint(returned: object, name: str, joints: tuple[str, ...]) -> Floats:
    try:
        values: Floats = np.asarray(returned, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.zeros(())
    if values.shape == (len(joints),):
        return values
    what = f"an array of shape {returned.shape}" if isinstance(returned, np.ndarray) else repr(returned)
    wanted = f"an array of {counted(len(joints), 'number', 'numbers')}, one per joint ({', '.join(joints)})"
    raise ControllerFault(f"returned {what[:_MOST_SHOWN]} from {name}; return {wanted}")


def _shown(name: str, place: int | None) -> property:
    """Return the property of a field: a parameter, or an element of `Context.reads`."""

    def value(self: JointController) -> object:
        return getattr(self.parameters, name) if place is None else float(self.context.reads[place])

    def refuse_assignment(self: JointController, value: object) -> None:
        raise AttributeError(f"{name} is a parameter; only the robot file and clients change it")

    return property(value, refuse_assignment)


def _fields(cls: type[JointController]) -> Iterator[tuple[str, tuple[Any, Any]]]:
    """Yield the fields of a class with types and defaults. Raises TypeError with one sentence."""
    own = vars(cls)
    annotated = own.get("__annotations__", {})
    for name, value in own.items():
        plain = isinstance(value, bool | int | float | str) and not name.startswith("_")
        if plain and name not in annotated and not hasattr(Controller, name):
            kind = "float" if isinstance(value, _Reading) else type(value).__name__
            raise TypeError(f"{cls.__name__}.{name} has no type; write {name}: {kind} = ...")
    try:
        hints = get_type_hints(cls, include_extras=True)
    except NameError as error:
        raise TypeError(f"a field of {cls.__name__} has an unknown type ({error}); import it") from None
    for name in annotated:
        if not name.startswith("_") and get_origin(hints[name]) is not ClassVar:
            yield name, _field(f"{cls.__name__}.{name}", name, hints[name], own.get(name, ...))


def _field(shown: str, name: str, kind: object, default: object) -> tuple[object, object]:
    """Return the type and the default of a parameter."""
    if hasattr(JointController, name) or name in _TAKEN:
        raise TypeError(f"{shown}: the base class already has this name; rename the field")
    if isinstance(default, _Reading):
        return Annotated[str, Field(min_length=1)], str(default) or ...
    probe: dict[str, Any] = {name: (kind, ...)}
    try:
        create_model(name, **probe)
    except PydanticUserError:
        raise TypeError(
            f"{shown} has the type {getattr(kind, '__name__', kind)}, which a key of a robot file cannot "
            "have; write float, int, bool, str, Angle, Frequency ..."
        ) from None
    plain = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    if plain not in (float, int, bool):
        return kind, default
    if default is not ... and not isinstance(default, int | float):
        raise TypeError(f"{shown} has the default {default!r}; write a number, in SI units")
    return Annotated[kind, LIVE], default
