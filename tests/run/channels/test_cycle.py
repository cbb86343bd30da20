"""The cycle record: one memory for the loop's arrays, the ring and the log's message."""

import numpy as np
import pytest

from dxlrun.channels.cycle import SEQUENCES, CycleLayout, CycleRecord, cycle_capacity
from dxlrun.channels.ring import record_size

SHAPES = [(0, 0), (1, 0), (3, 1), (8, 2), (18, 5)]


def layout_of(joints: int, controllers: int, references: int = 0, sources: int = 0) -> CycleLayout:
    return CycleLayout(
        [f"j{i}" for i in range(joints)],
        [f"c{i}" for i in range(controllers)],
        [f"c{i}/j0/position" for i in range(references)],
        {f"s{i}": ("x", "y") for i in range(sources)},
        [f"s{i}/led" for i in range(sources)],
    )


@pytest.mark.parametrize(("references", "sources"), [(0, 0), (1, 3), (7, 1)])
@pytest.mark.parametrize(("joints", "controllers"), SHAPES)
def test_no_two_fields_share_a_byte_and_lengths_are_set(joints, controllers, references, sources):
    layout = layout_of(joints, controllers, references, sources)
    used = np.zeros(layout.size, dtype=int)
    fields = layout.dtype.fields
    assert fields is not None
    for kind, offset, *_ in fields.values():
        used[offset : offset + kind.itemsize] += 1
    assert used.max() == 1
    record = np.frombuffer(bytes(CycleRecord(layout).raw), dtype=layout.dtype)[0]
    for name, _, per in SEQUENCES:
        counts = {"joints": joints, "controllers": controllers, "references": references}
        counts |= {"sources": sources, "source_states": 2 * sources, "source_commands": sources}
        assert record[f"{name}_length"] == counts[per]
        assert len(record[name]) == record[f"{name}_length"]


def test_before_the_first_reply_nothing_is_known():
    states = CycleRecord(layout_of(2, 1)).states
    assert np.isnan(states.position).all()
    assert not states.valid.any()
    assert (states.age_ns == -1).all()
    sources = CycleRecord(layout_of(2, 1, sources=2)).sources
    assert np.isnan(sources.values).all()
    assert not sources.valid.any()
    assert (sources.age_ns == -1).all()


def test_the_mask_of_controllers_has_an_end():
    record = CycleRecord(layout_of(1, 63))
    record.active = 1 << 62
    read = np.frombuffer(bytes(record.raw), dtype=record.layout.dtype)[0]
    assert int(read["active"]) == 1 << 62
    with pytest.raises(ValueError, match="more than 63"):
        layout_of(1, 64)


@pytest.mark.parametrize("rate", [50, 320, 1000])
def test_the_ring_holds_ten_seconds(rate):
    assert cycle_capacity(1_000_000_000 // rate, 1000) >= 10 * rate * record_size(1000)


def test_states_of_a_source_are_its_own():
    layout = CycleLayout((), (), (), {"imu": ("x", "y"), "imu2": ("x",)})
    slices = [layout.source_slice(source) for source in ("imu", "imu2", "im")]
    assert slices == [slice(0, 2), slice(2, 3), slice(0, 0)]
