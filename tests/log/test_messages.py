"""Messages: definitions are those that ROS 2 publishes, and rosbags reads the bytes, field by field."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from dxlrun import Floats, messages
from dxlrun.channels.cycle import SCALARS, SEQUENCES, CycleLayout, CycleRecord
from dxlrun.log import schemas
from dxlrun.messages import Header, Length, Number, Time
from dxlrun.messages.cdr import ENCAPSULATION, Codec
from dxlrun.messages.declared import WrongMessage, declared_message, package_of
from dxlrun.messages.definition import MessageType

if TYPE_CHECKING:
    from fractions import Fraction

KNOWN = [kind for kind in vars(messages).values() if hasattr(kind, "ros_type")]
TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)
FLOATS = st.lists(st.floats(), max_size=5)


@cache
def store_of(kind: MessageType) -> Typestore:
    """Return rosbags with our definition of a message, which has its hash."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(kind.text, kind.name))
    assert store.hash_rihs01(kind.name) == kind.type_hash
    return store


def read_by_rosbags(kind: MessageType, data: bytes) -> Any:
    """Return a message as rosbags reads it; it packs the same bytes."""
    found = store_of(kind).deserialize_cdr(data, kind.name)
    assert bytes(store_of(kind).serialize_cdr(found, kind.name)) == data
    return found


@dataclass
class Part:
    name: str
    ratio: float


@dataclass
class Sizes:
    good: bool
    amount: float
    level: Annotated[int, Number("uint8")]
    short: Annotated[int, Number("int16")]


@dataclass
class Group:
    text: str
    sizes: Sizes
    numbers: tuple[float, ...]


@dataclass
class Everything:
    header: Header
    amount: float
    count: int
    good: bool
    text: str
    rows: Floats
    small: NDArray[np.uint8]
    names: tuple[str, ...]
    numbers: tuple[float, ...]
    wholes: list[int]
    square: Annotated[Floats, Length(4)]
    level: Annotated[int, Number("uint8")]
    part: Part
    parts: tuple[Part, ...]
    one: Group
    wide: int
    two: Group
    more: tuple[Sizes, ...]


BYTES, WHOLES = st.integers(0, 255), st.integers(-(2**63), 2**63 - 1)
PART = st.builds(Part, TEXT, st.floats())
SIZES = st.builds(Sizes, st.booleans(), st.floats(), BYTES, st.integers(-(2**15), 2**15 - 1))
GROUP = st.builds(Group, TEXT, SIZES, FLOATS.map(tuple))
EVERYTHING = st.builds(
    Everything,
    st.builds(Header, frame_id=TEXT),
    amount=st.floats(),
    count=WHOLES,
    good=st.booleans(),
    text=TEXT,
    rows=FLOATS.map(np.array),
    small=st.lists(BYTES, max_size=5).map(lambda row: np.array(row, np.uint8)),
    names=st.lists(TEXT, max_size=3).map(tuple),
    numbers=FLOATS.map(tuple),
    wholes=st.lists(WHOLES, max_size=3),
    square=st.lists(st.floats(), min_size=4, max_size=4).map(np.array),
    level=BYTES,
    part=PART,
    parts=st.lists(PART, max_size=3).map(tuple),
    one=GROUP,
    wide=WHOLES,
    two=GROUP,
    more=st.lists(SIZES, max_size=3).map(tuple),
)
NOTHING = Group("", Sizes(True, 0.0, 0, 0), ())
RIGHT = Everything(
    *(Header(), 1.5, -7, True, "", np.zeros(2), np.zeros(0, np.uint8), (), (), [], np.zeros(4), 200),
    *(Part("one", 0.1), (), NOTHING, 0, NOTHING, ()),
)


@pytest.mark.parametrize("kind", KNOWN, ids=lambda kind: kind.__name__)
def test_a_known_message_is_the_published_one(kind, typestore):
    declared = declared_message(kind, "nothing").type
    assert declared.name == kind.ros_type  # type: ignore[attr-defined]  # the list was filtered by it
    assert declared.type_hash == typestore.hash_rihs01(declared.name)
    read_by_rosbags(declared, declared_message(kind, "nothing").pack(kind(), (12, 34)))


def values(message: Any) -> Any:
    """Return what the fields of a message are, as mappings and lists."""
    if dataclasses.is_dataclass(message):
        message = {name: value for name, value in vars(message).items() if name != "__msgtype__"}
    if isinstance(message, dict):
        return {name: values(value) for name, value in message.items()}
    return list(map(values, message)) if isinstance(message, np.ndarray | list | tuple) else message


@settings(max_examples=100, deadline=None)
@given(EVERYTHING)
def test_an_own_message_is_read_by_rosbags_field_by_field(message):
    declared = declared_message(Everything, "my_robotics")
    assert declared.type.name == "my_robotics/msg/Everything"
    data = declared.pack(message, (12, 34))
    stamp = {"sec": 12, "nanosec": 34}
    expected = values(message) | {"header": {"stamp": stamp, "frame_id": message.header.frame_id}}
    np.testing.assert_equal(values(read_by_rosbags(declared.type, data)), expected)
    np.testing.assert_equal(values(Codec(declared.type).unpack(data)), expected)


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("amount", "much", "Everything.amount: required argument is not a float"),
        ("count", 1.5, "Everything.count: required argument is not an integer"),
        ("count", 1 << 63, "Everything.count"),
        ("level", 256, "Everything.level: .* format requires 0 <= number <= 255"),
        ("text", b"bytes", "Everything.text: bytes given, text expected"),
        ("rows", np.zeros((2, 2)), r"rows: an array of shape \(2, 2\) given, one row expected"),
        ("rows", np.zeros(2, np.float32), "rows: float32 given, float64 expected"),
        ("rows", [1.0], "rows: list given, an array of float64 expected"),
        ("rows", b"12345678", "rows: bytes given, an array of float64 expected"),
        ("names", ("a", 3), "names: int given, text expected"),
        ("names", "abc", "names: str given, a sequence expected"),
        ("numbers", np.zeros(2), "numbers: ndarray given, a tuple expected"),
        ("numbers", ("a",), "numbers: could not convert string to float"),
        ("square", np.zeros(3), "square: 3 numbers given, 4 expected"),
        ("part", None, "part: NoneType given, Part expected"),
        ("parts", (Part("x", 0.0), 4), "parts: int given, Part expected"),
        ("header", Time(), "header: Time given, Header expected"),
    ],
)
def test_a_value_that_does_not_fit_is_named_with_its_field(field, value, reason):
    declared = declared_message(Everything, "my_robotics")
    with pytest.raises(WrongMessage, match=reason):
        declared.pack(dataclasses.replace(RIGHT, **{field: value}), (0, 0))


def test_a_message_of_another_class_is_refused():
    with pytest.raises(WrongMessage, match="dict given, Part expected"):
        declared_message(Part, "mine").pack({"name": "x", "ratio": 0.1}, (0, 0))
    with pytest.raises(ValueError, match="has the fields header, name"):
        Codec(schemas.JOINT_STATE).pack(((0, 0), ""), [])


def made(**annotations: object) -> type:
    return dataclasses.make_dataclass("Made", list(annotations.items()))


@dataclass
class Lazy:
    share: Fraction


@dataclass
class Endless:
    parts: tuple[Endless, ...]


@dataclass
class lower:  # noqa: N801  what is refused
    amount: float


@dataclass
class Odd:
    ros_type = "Odd"
    amount: float


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        (dict, "dict is not a dataclass"),
        (3, "3 is not a dataclass"),
        (made(), "Made has no fields"),
        (made(amount=complex), "Made.amount is complex, and ROS 2 has no type for it"),
        (made(amount=float | None), "Made.amount is float | None, and ROS 2 has no type for it"),
        (made(amount=np.ndarray), "Made.amount is ndarray, and ROS 2 has no type for it"),
        (made(amount=NDArray[np.complex128]), "Made.amount is .*complex128.*, and ROS 2 has no type for it"),
        (made(amount=dict[str, float]), r"Made.amount is dict\[str, float\], and ROS 2"),
        (made(amount=tuple[float, str]), "Made.amount is tuple"),
        (made(amount=tuple[Floats, ...]), "Made.amount is tuple"),
        (made(amount=Annotated[float, Number("uint8")]), "Made.amount is .*, and ROS 2"),
        (made(amount=Annotated[int, Number("number")]), "Made.amount is .*, and ROS 2"),
        (made(amount=Annotated[str, Length(3)]), "Made.amount is .*, and ROS 2"),
        (made(amountLeft=float), "Made.amountLeft is not a valid name of a field"),
        (made(left__amount=float), "Made.left__amount is not a valid name of a field"),
        (Lazy, "the annotations of Lazy cannot be read .*Fraction"),
        (Endless, "Endless contains itself"),
        (lower, "lower is not a valid name of a message"),
        (Odd, "Odd.ros_type is 'Odd'"),
    ],
)
def test_what_ros_has_no_message_for_is_refused(kind, reason):
    with pytest.raises(WrongMessage, match=reason) as refused:
        declared_message(kind, "mine")
    assert refused.value.fix


def test_two_classes_of_one_name_are_refused():
    other = dataclasses.make_dataclass("Part", [("ratio", float)])
    with pytest.raises(WrongMessage, match="two classes have the message name mine/msg/Part"):
        declared_message(made(one=Part, two=other), "mine")


@pytest.mark.parametrize(
    ("distribution", "package"),
    [
        ("dxlrun 0.1.0", "dxlrun"),
        ("My-Robotics 2", "my_robotics"),
        ("3d.arm 1", "package_3d_arm"),
        ("x", "x"),
    ],
)
def test_the_package_is_made_of_the_distribution(distribution, package):
    assert package_of(distribution) == package


# Messages of the log


@pytest.mark.parametrize(("joints", "controllers"), [(0, 0), (1, 0), (3, 1), (8, 3)])
def test_a_cycle_record_is_the_message_as_it_is(joints, controllers, typestore):
    layout = CycleLayout([f"j{i}" for i in range(joints)], [f"c{i}" for i in range(controllers)])
    record = CycleRecord(layout)
    for number, (name, _) in enumerate(SCALARS):
        setattr(record, name, 100 + number)
    record.states.position[:] = np.arange(joints) + 0.5
    record.goals.velocity[:] = -1.0
    record.controller_ns[:] = 9
    record.valid[:] = True
    record.clamped[:] = 5
    data = ENCAPSULATION + bytes(record.raw)
    message = typestore.deserialize_cdr(data, schemas.CYCLE.name)
    for number, (name, _) in enumerate(SCALARS):
        assert getattr(message, name) == 100 + number
    values = np.frombuffer(bytes(record.raw), dtype=layout.dtype)[0]
    for name, _, _ in SEQUENCES:
        np.testing.assert_array_equal(getattr(message, name), values[name])
    ours = Codec(schemas.CYCLE).unpack(data)
    for name, _, _ in SEQUENCES:
        np.testing.assert_array_equal(ours[name], values[name])


@pytest.mark.parametrize("cut", [3, 10, 30, 41, -1])
def test_a_cut_message_is_refused(cut):
    codec = Codec(schemas.EVENT)
    data = codec.pack(1, 2, 3, 0, "name", "source", "text", "{}")
    with pytest.raises(ValueError, match=r"Event|longer than its message"):
        codec.unpack(data[:cut])
