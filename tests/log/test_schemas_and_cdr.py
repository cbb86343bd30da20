"""Messages: our packers agree with rosbags, our hashes with its hashes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from dxlrun.channels.cycle import SCALARS, SEQUENCES, CycleLayout, CycleRecord
from dxlrun.log import schemas
from dxlrun.messages.cdr import ENCAPSULATION, Codec
from dxlrun.messages.definition import MessageType, parse

MESSAGES = [
    schemas.JOINT_STATE,
    schemas.ROS_LOG,
    schemas.CYCLE,
    schemas.BUS_PACKETS,
    schemas.EVENT,
    schemas.COMMAND,
    schemas.STRING,
    schemas.MACHINE,
]
TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)
FLOATS = st.lists(st.floats(width=64), max_size=5)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.name)
def test_the_hash_is_that_of_the_text(message: MessageType) -> None:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(message.text, message.name))
    assert store.hash_rihs01(message.name) == message.type_hash


@pytest.mark.parametrize(
    "message", [schemas.JOINT_STATE, schemas.ROS_LOG, schemas.STRING], ids=lambda message: message.name
)
def test_the_text_of_a_standard_message_is_the_standard_one(
    message: MessageType, typestore: Typestore
) -> None:
    assert typestore.hash_rihs01(message.name) == message.type_hash


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(st.integers(0, 2**31 - 1), st.integers(0, 10**9)),
    TEXT,
    st.lists(TEXT, max_size=4),
    FLOATS,
    FLOATS,
)
def test_joint_states_are_read_by_rosbags(
    stamp: tuple[int, int], frame: str, names: list[str], position: list[float], effort: list[float]
) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    data = Codec(schemas.JOINT_STATE).pack(
        (stamp, frame), names, np.array(position), np.zeros(0), np.array(effort)
    )
    message: Any = store.deserialize_cdr(data, schemas.JOINT_STATE.name)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == stamp
    assert message.header.frame_id == frame
    assert message.name == names
    np.testing.assert_array_equal(message.position, position)
    np.testing.assert_array_equal(message.effort, effort)
    again = store.serialize_cdr(message, schemas.JOINT_STATE.name)
    assert bytes(again) == data


@pytest.mark.parametrize(("joints", "controllers"), [(0, 0), (1, 0), (3, 1), (8, 3)])
def test_a_cycle_record_is_the_message_as_it_is(joints: int, controllers: int, typestore: Typestore) -> None:
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


def test_values_that_do_not_fit_their_field_are_refused() -> None:
    codec = Codec(schemas.JOINT_STATE)
    good = ((0, 0), ""), ["a"], np.zeros(1), np.zeros(1), np.zeros(1)
    codec.pack(*good)
    with pytest.raises(ValueError, match="float32 given"):
        codec.pack(*good[:4], np.zeros(1, dtype=np.float32))
    with pytest.raises(ValueError, match="an array of float64 expected"):
        codec.pack(*good[:4], b"12345678")
    with pytest.raises(ValueError, match="text expected"):
        codec.pack(((0, 0), 5), *good[1:])
    with pytest.raises(ValueError, match="a sequence expected"):
        codec.pack(good[0], "abc", *good[2:])
    with pytest.raises(ValueError, match="has the fields header, name"):
        codec.pack(*good[:2])


@pytest.mark.parametrize("cut", [3, 10, 30, 41, -1])
def test_a_cut_message_is_refused(cut: int) -> None:
    codec = Codec(schemas.EVENT)
    data = codec.pack(1, 2, 3, 0, "name", "source", "text", "{}")
    with pytest.raises(ValueError, match=r"Event|longer than its message"):
        codec.unpack(data[:cut])


def test_a_definition_that_is_not_laid_out_is_refused() -> None:
    with pytest.raises(ValueError, match="the type a/wide of bounded is not defined"):
        parse(MessageType("a/msg/B", "wide[<=3] bounded\n"))
