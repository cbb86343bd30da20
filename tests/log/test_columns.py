"""Columns and packets of a log: each field is what the codec reads, and damaged messages are left out."""

import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from mcap_ros2.writer import Writer as RosWriter
from tests.kit.decoded import decode_log
from tests.kit.pages import page_text

import dxlrun
from dxlrun import InputError, LogError, open_log
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.logged_packets import PacketBatch
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.log import log_reader, log_writer, schemas
from dxlrun.log.columns import PacketColumns
from dxlrun.log.log_reader import read_log
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.packing.bus_messages import pack_packets, read_packets
from dxlrun.log.schemas import LogHeader
from dxlrun.messages.cdr import Codec
from dxlrun.messages.cdr_columns import ColumnReader
from dxlrun.messages.definition import MessageType
from dxlwire.packets import PacketKind

Cycle = Callable[[int], bytes]
KEYS = ["temperature", "voltage", "hardware_error", "mode"]
RULE = "=" * 80
MIXED = MessageType(
    "a/msg/Mixed",
    f"""uint8 LEVEL=3
string<=9 name "arm # in particular"
Inner[] inner
int16[3] three
uint8 flag 1
float64[<=4] bounded
other/Empty nothing
string[] words
Inner one
bool last
{RULE}
MSG: a/Inner
int8 small
float64[] wide
string text
{RULE}
MSG: other/Empty
""",
)
TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=5)
FLOATS = st.lists(st.floats(allow_nan=False), max_size=4).map(lambda row: np.array(row, np.float64))
INNER = st.tuples(st.integers(-128, 127), FLOATS, TEXTS)
ROWS = st.lists(
    st.tuples(
        TEXTS,
        st.lists(INNER, max_size=3),
        st.lists(st.integers(-9, 9), min_size=3, max_size=3).map(lambda row: np.array(row, np.int16)),
        st.integers(0, 255),
        FLOATS,
        st.just((0,)),
        st.lists(TEXTS, max_size=3),
        INNER,
        st.booleans(),
    ),
    min_size=1,
    max_size=6,
)
WRITTEN = MessageType(
    MIXED.name, MIXED.text.replace("MSG: other/Empty\n", "MSG: other/Empty\nuint8 unused\n")
)


def plain(value: Any) -> Any:
    """Whatever a message's value is, as lists."""
    if isinstance(value, Mapping):
        return {name: plain(one) for name, one in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(one) for one in value]
    return value.item() if isinstance(value, np.generic) else value


def laid(messages: list[bytes], front: int) -> tuple[Any, Any, Any]:
    sizes = np.array([len(one) for one in messages], np.int64)
    return np.frombuffer(bytes(front) + b"".join(messages), np.uint8), np.cumsum(sizes) - sizes + front, sizes


def at_place(message: Any, place: str) -> Any:
    name, _, rest = place.partition(".")
    if isinstance(message, list):
        return [at_place(one, place) for one in message]
    return at_place(message[name], rest) if rest else message[name]


@settings(max_examples=60, deadline=None)
@given(ROWS, st.integers(0, 9), st.data())
def test_every_field_is_what_the_codec_reads(rows, front, data):
    codec, reader = Codec(WRITTEN), ColumnReader(MIXED)
    messages = [codec.pack(*row) for row in rows]
    fields = data.draw(st.one_of(st.none(), st.lists(st.sampled_from(reader.leaves), unique=True)))
    whole, tree = reader.read_columns(*laid(messages, front), fields)
    assert len(whole) == len(messages)
    expected = [plain(codec.unpack(message)) for message in messages]
    for place in reader.leaves if fields is None else fields:
        assert plain(tree.leaf(place).array()) == [at_place(message, place) for message in expected]


@settings(max_examples=80, deadline=None)
@given(ROWS, st.data())
def test_a_damaged_message_is_left_out_and_the_others_are_read(rows, data):
    codec, reader = Codec(WRITTEN), ColumnReader(MIXED)
    messages = [bytearray(codec.pack(*row)) for row in rows]
    hit = data.draw(st.integers(0, len(rows) - 1))
    for _ in range(data.draw(st.integers(1, 4))):
        messages[hit][data.draw(st.integers(4, len(messages[hit]) - 1))] = data.draw(st.integers(0, 255))
    messages[hit] = messages[hit][: data.draw(st.integers(4, len(messages[hit])))]
    whole, tree = reader.read_columns(*laid([bytes(one) for one in messages], 0))
    others = [row for row in range(len(rows)) if row != hit]
    assert set(others) <= set(whole.tolist())
    for place in reader.leaves:
        column = plain(tree.select_rows(np.flatnonzero(whole != hit)).leaf(place).array())
        assert column == [at_place(plain(codec.unpack(bytes(messages[row]))), place) for row in others]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("B b\n=====\nMSG: a/B\nA back\n=====\nMSG: a/A\nB there\n", "contains itself"),
        ("wstring x\n", "the type wstring of x is not defined"),
        ("uint8 X\n", "cannot parse"),
    ],
)
def test_a_definition_that_cannot_be_laid_out_is_refused(text, sentence):
    with pytest.raises(ValueError, match=sentence):
        ColumnReader(MessageType("a/msg/Top", text))


@pytest.fixture
def written(path, log, cycle):
    batches: list[bytes] = []
    batch = PacketBatch(Handover(lambda _, payload: batches.append(bytes(payload))))
    for number in range(100):
        batch.wake(number)
        batch.packet(0, PacketKind.INSTRUCTION, 1, 7 + number, 9 + number, b"abc")
        batch.packet(1, PacketKind.STATUS, 2, 8 + number, 9 + number, bytes([number]))
        batch.commit_packets()
        log.write_record(RecordKind.CYCLE, cycle(number))
        while len(batches) > 3:  # packets may come later than their cycles
            log.write_record(RecordKind.PACKETS, batches.pop(0))
        if number % 10 == 5:
            log.finish_chunk()
        batch.packet(0, PacketKind.NOISE, 3, 8 + number, 9 + number, b"idle")
    batch.commit_packets()
    for payload in batches:
        log.write_record(RecordKind.PACKETS, payload)
    log.close()
    return path


def test_topics_of_a_log_are_columns(written, monkeypatch):
    monkeypatch.setattr(log_reader, "SLICE_BYTES", 1)
    log = read_log(written)
    with open_log(written) as reader:
        assert reader.header is not None
        assert reader.topics["/cycle"] == dxlrun.Topic("dxlrun_msgs/msg/Cycle", 100)
        assert reader.topics["/joint_states"].count == 50
        assert reader.damage == ()
        found = reader.columns("/cycle", "cycle", "position", "valid", "reference")
        assert found["cycle"].tolist() == list(range(100))
        np.testing.assert_array_equal(found["position"], log.cycles["position"])
        assert found["reference"].shape == (100, 0)
        assert found["t_ns"].tolist() == log.cycles["written_ns"].tolist()
        states = reader.columns("/joint_states")
        stamp = {"t_ns", "header.stamp.sec", "header.stamp.nanosec", "header.frame_id"}
        assert set(states) == stamp | {"name", "position", "velocity", "effort"}
        assert states["name"][7].tolist() == ["head_pitch_joint", "head_yaw_joint"]
        assert len(list(reader.batches("/joint_states", "position"))) > 5
        status = reader.columns("/diagnostics", "status.name", "status.values.key")
        assert status["status.name"].shape[1] == 3
        assert status["status.values.key"][0, 0].tolist() == KEYS
        packets = reader.columns("/bus/main", "cycle_delta", "kind")
        assert sum(map(len, packets["cycle_delta"])) == sum(map(len, packets["kind"])) == 200


def test_slices_have_whole_cycles_with_all_their_packets(written, monkeypatch):
    monkeypatch.setattr(log_reader, "SLICE_BYTES", 1)
    slices = list(open_log(written).slices())
    assert len(slices) > 8
    for part in slices:
        assert sorted(part.cycles["cycle"].tolist() * 3) == sorted(part.packets.cycle.tolist())
        assert (np.diff(part.packets.bus.astype(int)) >= 0).all()
    numbers = [number for part in slices for number in part.cycles["cycle"].tolist()]
    assert numbers == list(range(100))


def test_arrow_has_the_same(written):
    pyarrow = pytest.importorskip("pyarrow", reason="the extra logs is not installed")
    table = open_log(written).arrow("/diagnostics").read_all()
    assert table.schema.field("header").type == pyarrow.struct(
        [
            ("stamp", pyarrow.struct([("sec", pyarrow.int32()), ("nanosec", pyarrow.uint32())])),
            ("frame_id", pyarrow.string()),
        ]
    )
    status = table["status"][0].as_py()
    assert [one["name"] for one in status] == list(read_log(written).joints)
    assert status[0]["values"][0]["key"] == "temperature"
    chosen = open_log(written).arrow("/diagnostics", "status.values.key", "header.stamp.sec").read_all()
    assert chosen.schema.names == ["t_ns", "status.values.key", "header.stamp.sec"]
    assert chosen["status.values.key"][0].as_py()[0] == KEYS


def test_without_pyarrow_the_extra_is_named(written, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"pip install 'dxlrun\[logs\]'"):
        open_log(written).arrow("/cycle")


@pytest.fixture(params=["zstd", "lz4", "none", "no chunks"])
def foreign(path, request):
    """What another program wrote, with its library."""
    kind = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}.get(request.param, CompressionType.NONE)
    with path.open("wb") as stream:
        writer = RosWriter(stream, chunk_size=4096, compression=kind)
        writer._writer._Writer__use_chunking = request.param != "no chunks"  # its front has no option for it
        if request.param == "no chunks":
            writer._writer._Writer__chunk_builder = None
        joint = writer.register_msgdef(schemas.JOINT_STATE.name.replace("/msg", ""), schemas.JOINT_STATE.text)
        for number in range(500):
            stamp = {"sec": number, "nanosec": 5}
            writer.write_message(
                topic="/joint_states",
                schema=joint,
                message={
                    "header": {"stamp": stamp, "frame_id": "base"},
                    "name": ["a", "b"][: 1 + number % 2],
                    "position": [0.5 * number] * (1 + number % 2),
                    "velocity": [],
                    "effort": [1.0],
                },
                log_time=10 * number,
                publish_time=10 * number,
                sequence=number,
            )
        writer.finish()
    return path


def test_a_foreign_file_has_columns_and_no_slices(foreign):
    reader = open_log(foreign)
    assert reader.header is None
    assert reader.topics == {"/joint_states": dxlrun.Topic("sensor_msgs/JointState", 500)}
    found = reader.columns("/joint_states")
    assert found["t_ns"].tolist() == list(range(0, 5000, 10))
    assert found["header.stamp.sec"].tolist() == list(range(500))
    assert [row.tolist() for row in found["position"][:4]] == [[0.0], [0.5, 0.5], [1.0], [1.5, 1.5]]
    assert found["effort"].shape == (500, 1)
    assert reader.damage == ()
    with pytest.raises(LogError, match="is not a log of dxlrun"):
        next(reader.slices())
    with pytest.raises(LogError, match="is not a log of dxlrun"):
        read_log(foreign)


def test_a_foreign_file_that_was_cut_is_read_as_far_as_it_is_there(foreign):
    data = foreign.read_bytes()
    foreign.write_bytes(data[: len(data) // 2])
    reader = open_log(foreign)
    count = len(reader.columns("/joint_states")["t_ns"])
    assert 50 < count < 500
    assert reader.topics["/joint_states"].count is None


def test_what_is_not_there_is_named(written):
    reader = open_log(written)
    with pytest.raises(LogError, match=r"run.mcap: no topic /joint_stats; did you mean /joint_states"):
        reader.columns("/joint_stats")
    with pytest.raises(LogError, match="messages of /cycle have no field positon; did you mean position"):
        next(reader.batches("/cycle", "positon"))


@pytest.mark.parametrize(
    ("encoding", "schema", "sentence"),
    [
        (
            "json",
            "jsonschema",
            "have the encoding 'json' and a schema in 'jsonschema'; dxlrun reads only 'cdr'",
        ),
        ("cdr", "ros2idl", "have the encoding 'cdr' and a schema in 'ros2idl'"),
        ("cdr", "ros2msg", "cannot be read: a/msg/X: the bytes are not little-endian CDR"),
    ],
)
def test_messages_in_another_encoding_are_refused_with_a_sentence(path, encoding, schema, sentence):
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        number = writer.register_schema("a/msg/X", schema, b"int32 x\n")
        channel = writer.register_channel("/x", encoding, number)
        writer.add_message(channel, 0, b"\0\0\0\0\1\2\3\4", 0)
        writer.finish()
    with pytest.raises(LogError, match=f"messages of /x {sentence}"):
        open_log(path).columns("/x")


def test_the_example_of_the_page_runs(written, capsys):
    page = page_text("analyze.md")
    example = page.split("```python\n")[1].split("```")[0]
    assert "open_log" in example
    exec(example.replace('"LOG"', repr(str(written))), {})  # noqa: S102  the page is ours
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].startswith("torso {'/cycle': 'dxlrun_msgs/msg/Cycle'")
    assert shown[1:] == ["99 60000 99", "1 60000 1", "(50, 2)", "()"]


PACKETS = [
    (0, PacketKind.INSTRUCTION, 254, 1, 2, b"\xff\xff\xfe\x02\x01\xfe"),
    (1, PacketKind.STATUS, 0, 3, 2**62, bytes(range(256))),
    (0, PacketKind.NOISE, 255, 5, 5, b""),
]
TIMES = st.integers(0, 2**63 - 1)
BATCHED = st.tuples(
    st.integers(-1, 9),
    st.just(0),
    st.integers(1, 3),
    st.integers(0, 255),
    TIMES,
    TIMES,
    st.binary(max_size=40),
)
MESSAGES = st.lists(st.lists(BATCHED, min_size=1, max_size=9), min_size=1, max_size=6)


def read_laid(messages: list[bytes], front: int = 0) -> tuple[PacketColumns, int]:
    """Read messages of bus 3 that are next to each other."""
    data, start, sizes = laid(messages, front)
    return read_packets(data, np.full(len(sizes), 3, np.uint8), start, sizes)


def shown(packets: PacketColumns) -> list[tuple[Any, ...]]:
    return [(one.kind, one.servo_id, one.first_ns, one.last_ns, one.data) for one in packets]


@settings(max_examples=60, deadline=None)
@given(MESSAGES, st.integers(0, 9))
def test_what_is_packed_is_read_again_wherever_it_lies_and_by_rosbags(typestore, messages, front):
    packed = [pack_packets(one) for one in messages]
    found, wrong = read_laid(packed, front)
    assert wrong == 0
    assert shown(found) == [packet[2:] for one in messages for packet in one]
    assert found.cycle.tolist() == [packet[0] for one in messages for packet in one]
    assert (found.bus == 3).all()
    theirs: Any = typestore.deserialize_cdr(packed[0], schemas.BUS_PACKETS.name)
    assert np.cumsum(theirs.cycle_delta).tolist() == [packet[0] for packet in messages[0]]
    assert np.cumsum(theirs.first_ns_delta).tolist() == [packet[4] for packet in messages[0]]
    assert bytes(theirs.kind) == bytes(packet[2] for packet in messages[0])
    assert bytes(theirs.data) == b"".join(packet[-1] for packet in messages[0])


@settings(max_examples=80, deadline=None)
@given(MESSAGES, st.data())
def test_a_message_that_is_damaged_is_left_out_and_counted_or_read(messages, data):
    packed = [bytearray(pack_packets(one)) for one in messages]
    hit = data.draw(st.integers(0, len(packed) - 1))
    for _ in range(3):
        packed[hit][data.draw(st.integers(0, len(packed[hit]) - 1))] = data.draw(st.integers(0, 255))
    packed[hit] = packed[hit][: data.draw(st.integers(0, len(packed[hit])))]
    found, wrong = read_laid([bytes(one) for one in packed])
    others = [packet[2:] for at, one in enumerate(messages) for packet in one if at != hit]
    if wrong:
        assert shown(found) == others
    else:
        assert len(found) >= len(others)


KIND_AT, LENGTH_AT, DATA_AT = 80, 96, 100
"""Of the first kind, of the first length, of the number of bytes in a message of two packets."""


@pytest.mark.parametrize("all_of_them", [False, True])
@pytest.mark.parametrize(
    ("at", "value"),
    [(0, 1), (1, 9), (4, 1), (KIND_AT, 0), (KIND_AT, 7), (LENGTH_AT, 2), (DATA_AT, 3)],
    ids=["no CDR", "another CDR", "count", "kind 0", "kind 7", "length", "bytes"],
)
def test_what_contradicts_itself_is_left_out(at, value, all_of_them):
    packets = [(7, 0, PacketKind.STATUS, 1, 5, 6, b"abc"), (7, 0, PacketKind.NOISE, 2, 7, 8, b"d")]
    good = pack_packets(packets)
    assert (good[KIND_AT], good[LENGTH_AT], good[DATA_AT]) == (PacketKind.STATUS, 3, 4)
    wrong = bytearray(good)
    wrong[at] = value
    found, lost = read_laid([bytes(wrong)] + [good] * (not all_of_them))
    assert lost == 1
    assert shown(found) == ([] if all_of_them else [packet[2:] for packet in packets])


def test_a_message_has_the_packets_of_a_bus_in_many_cycles(path):
    log = LogWriter(path, LogHeader("r", (), ("main", "arm"), (), 10**6, 0))
    batch = PacketBatch(Handover(log.write_record))
    batch.packet(*PACKETS[0])
    batch.commit_packets()
    for cycle in (0, 1, 249, 251):
        batch.wake(cycle)
        for packet in PACKETS:
            batch.packet(*packet)
        batch.commit_packets()
        batch.packet(0, PacketKind.NOISE, 9, 6, 6, b"idle")
    batch.commit_packets()
    log.close()
    written = [
        (one.topic, len(set(np.cumsum(one.message.cycle_delta).tolist())))
        for one in decode_log(path, in_order=False)
    ]
    assert written == [("/bus/main", 4), ("/bus/arm", 2), ("/bus/main", 2), ("/bus/arm", 2)]
    packets = read_log(path).packets
    main = packets.select_rows(packets.bus == 0)
    assert list(zip(main.cycle.tolist(), main.servo_id.tolist(), strict=True)) == [
        (-1, 254),
        *((cycle, servo_id) for cycle in (0, 1, 249, 251) for servo_id in (254, 255, 9)),
    ]
    assert packets.cycle[packets.bus == 1].tolist() == [0, 1, 249, 251]
    assert [one.first_ns for one in main] == [1, *(1, 5, 6) * 4]


def test_a_chunk_has_the_packets_of_its_cycles(path, monkeypatch):
    """A recorder that is killed leaves whole chunks, and no cycle in them whose packets are missing."""
    monkeypatch.setattr(log_writer, "CHUNK_BYTES", 2000)
    header = LogHeader("r", (), ("main",), (), 10**6, 0)
    log, record = LogWriter(path, header), CycleRecord(header.layout)
    batch = PacketBatch(Handover(log.write_record))
    for cycle in range(100):
        batch.wake(cycle)
        batch.packet(*PACKETS[0])
        batch.commit_packets()
        record.cycle = cycle
        log.write_record(RecordKind.CYCLE, record.raw)
    read = read_log(path)
    assert 80 < len(read.cycles) < 100
    assert not read.complete
    assert read.packets.cycle.tolist() == read.cycles["cycle"].tolist()
