"""Wake-up latency: what is measured, in which order, and its statistics; no time decides here."""

import itertools
import json
import math
import re
import shutil
import subprocess
from collections import Counter
from dataclasses import replace
from pathlib import Path
from statistics import mean, stdev
from unittest.mock import MagicMock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from tests.kit.changed_logs import write_changed

from dxlrun.control.deadlines import Deadlines
from dxlrun.errors import LogError
from dxlrun.log.log_reader import open_log, read_log
from dxlrun_analysis.latency import latency_log, latency_tables
from dxlrun_analysis.latency.conditions import Condition, Settings, conditions, order
from dxlrun_analysis.latency.latency_page import page
from dxlrun_analysis.latency.statistics import Block, figures, interval, mode_us, t_quantile
from dxlrun_lab.latency import latency_measurement, wake_ups
from dxlrun_lab.latency.buffer import Buffer, BufferOffset
from dxlrun_lab.latency.latency_measurement import compiled_yardstick
from dxlrun_lab.latency.wake_ups import measure_wake_ups

PERIOD = 1_000_000
OTHER, FIFO, ROUND_ROBIN = (Condition(name, name) for name in ("other", "fifo", "round_robin"))
C = Condition("c", "round_robin")


def settings(*found: Condition, iterations: int = 8, blocks: int = 2) -> Settings:
    return Settings(iterations, PERIOD, 31, found, blocks)


class LateClock:
    """Wakes late by given times."""

    def __init__(self, late: list[int]) -> None:
        self.time, self.late = 5_000, iter(late)

    def now_ns(self) -> int:
        return self.time

    def wait_until(self, deadline_ns: int) -> int:
        self.time = max(self.time, deadline_ns) + next(self.late)
        return self.time


def measured(late: list[int], stop: bool = False) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """Return the wake-ups that a clock with these delays gives, ns since the first deadline."""
    buffer = Buffer.create(len(late))
    buffer.words[BufferOffset.STOP] = stop
    measure_wake_ups(Deadlines(PERIOD, LateClock(late)), len(late), buffer)
    times = buffer.wake_ups()
    assert buffer.words[BufferOffset.DONE] == len(times)
    buffer.close()
    return times - (5_000 + PERIOD)


def test_each_wake_up_has_its_deadline_on_the_grid_and_those_that_passed_are_skipped():
    times = measured([PERIOD + 1, 0, 3 * PERIOD, 0])
    assert (times[:, 0] // PERIOD).tolist() == [0, 2, 3, 6]
    assert (times[:, 1] - times[:, 0]).tolist() == [PERIOD + 1, 0, 3 * PERIOD, 0]
    assert len(measured([7, 7, 7], stop=True)) == 1, "a whole wake-up after it was asked to end"


def test_the_buffer_can_be_read_while_it_is_filled():
    buffer = Buffer.create(3)
    assert (buffer.wake_ups().shape, buffer.worst_ns(0, 0)) == ((0, 2), 0)
    for number, (due, woken) in enumerate(((10, 12), (20, 29), (30, 31))):
        buffer.words[BufferOffset.WAKE_UPS + 2 * number] = due
        buffer.words[BufferOffset.WAKE_UPS + 2 * number + 1] = woken
    buffer.words[BufferOffset.DONE] = 2
    assert buffer.wake_ups().tolist() == [[10, 12], [20, 29]]
    assert [buffer.worst_ns(0, 2), buffer.worst_ns(0, 1), buffer.worst_ns(2, 3)] == [9, 2, 1]
    buffer.close()


def test_a_wake_up_is_published_when_both_its_times_are_there(monkeypatch):
    published = []
    monkeypatch.setattr(
        wake_ups, "store", lambda words, *word: published.append((*word, words[8:12].tolist()))
    )
    measured([100, 0])
    first, second = PERIOD + 5_000, 2 * PERIOD + 5_000
    assert published == [
        (BufferOffset.DONE, 1, [first, first + 100, 0, 0]),
        (BufferOffset.DONE, 2, [first, first + 100, second, second]),
    ]


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_yardstick_skips_deadlines_that_passed_and_keeps_their_phase(tmp_path, monkeypatch):
    """Nothing of it is on the disk, so that nothing stays of it when the front process is killed."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    period_ns = 100  # shorter than any wait
    buffer = Buffer.create(50)
    with compiled_yardstick(settings(C)) as program:
        assert Path(program).read_bytes().startswith(b"\x7fELF")
        assert not list(tmp_path.iterdir())
        words = (program, str(buffer.descriptor), "50", str(period_ns), "0")
        assert subprocess.run(words, pass_fds=(buffer.descriptor,), check=False).returncode == 0
    assert not Path(program).exists()
    times = buffer.wake_ups()
    assert len(times) == 50
    assert not ((times[:, 0] - times[0, 0]) % period_ns).any()
    assert (times[:, 1] >= times[:, 0]).all()
    assert (times[1:, 0] >= times[:-1, 1]).all()  # not one whose time had come before the wait for it began
    assert buffer.words[BufferOffset.CPU_NS] > 0
    assert buffer.words[BufferOffset.WALL_NS] > 0
    buffer.close()


@pytest.mark.parametrize(
    ("compare", "policy", "expected"),
    [
        (None, None, "other"),
        (None, "fifo", "fifo"),
        ("other,round_robin", None, "other round_robin"),
        ("other, round_robin ,c", None, "other round_robin c:round_robin"),
        ("c,fifo,other", None, "c:fifo fifo other"),
        ("other,fifo,c", "round_robin", "other fifo c:round_robin"),
        ("c", None, "round_robin c:round_robin"),
        ("c", "other", "other c:other"),
    ],
)
def test_the_yardstick_has_the_policy_of_what_it_is_compared_with(compare, policy, expected):
    shown = (
        one.name if one.name == one.policy else f"{one.name}:{one.policy}"
        for one in conditions(compare, policy)
    )
    assert " ".join(shown) == expected


@given(st.integers(1, 40), st.integers(0, 200))
def test_the_blocks_have_all_iterations(blocks, more):
    whole = settings(OTHER, iterations=blocks + more, blocks=blocks)
    shares = [whole.share(number) for number in range(blocks)]
    assert sum(shares) == whole.iterations
    assert max(shares) - min(shares) <= 1


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_the_order_of_the_blocks_is_counterbalanced(number):
    all_of_them = (OTHER, ROUND_ROBIN, FIFO, C)[:number]
    rounds = [order(all_of_them, block) for block in range(2 * number)]
    assert all(set(one) == set(all_of_them) for one in rounds)
    places = Counter((condition, place) for one in rounds for place, condition in enumerate(one))
    assert set(places.values()) == {2}
    if number <= 3:
        pairs = Counter(pair for one in rounds for pair in itertools.pairwise(one))
        assert all(pairs[first, second] == pairs[second, first] for first, second in pairs)


def test_a_measurement_alternates_its_conditions(monkeypatch):
    asked = []
    process = MagicMock()
    monkeypatch.setattr(
        latency_measurement, "_Process", lambda _, condition, *__: asked.append(condition) or process
    )
    found = settings(OTHER, FIFO, blocks=2)
    latency_measurement.measure_blocks(found, "", MagicMock(), MagicMock(), MagicMock())
    assert asked == [OTHER, FIFO, FIFO, OTHER]


@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_intervals_are_those_of_student_by_scipy(confidence):
    from scipy import stats

    for freedom in (1, 2, 3, 4, 5, 9, 30, 99, 100):
        expected = stats.t.ppf((1 + confidence) / 2, freedom)
        assert t_quantile(freedom, confidence) == pytest.approx(expected)
    values = [3.0, 4.5, 2.0, 3.5, 9.0]
    found = interval(values)
    low, high = stats.t.interval(0.95, 4, loc=mean(values), scale=stdev(values) / math.sqrt(5))
    assert (found.mean, found.low, found.high) == pytest.approx((mean(values), low, high))
    assert (interval([4.0]).mean, interval([4.0]).low) == (4.0, None)


def block(condition: Condition, number: int, late_us: list[float], skip: int = 0) -> Block:
    due = 10**9 + np.arange(len(late_us), dtype=np.int64) * PERIOD
    due[len(due) // 2 :] += skip * PERIOD
    times = np.column_stack((due, due + np.round(np.array(late_us) * 1000).astype(np.int64)))
    return Block(condition.name, number, times, cpu_ns=25_000, wall_ns=100_000, margin_ns=70_000)


def test_the_thesis_table_of_known_wake_ups():
    assert mode_us(np.array([4_999, 4_000, 7_100, 7_900, 60_000])) == 4, "the smallest of several"
    assert mode_us(np.array([300, 999, 1_000])) == 0
    late = [1.0, 2.0, 2.5, 150.0, 151.0, 1000.0, 1001.0, 2.9]
    result = figures(settings(OTHER), [block(OTHER, 0, late[:4]), block(OTHER, 1, late[4:], skip=3)])
    (one,) = result.conditions
    assert (one.wake_ups, one.skipped) == (8, 3)
    assert (one.max_us, one.mean_us, one.mode_us) == (1001.0, pytest.approx(mean(late)), 2)
    assert one.deviation_us == pytest.approx(float(np.std(late)))
    assert (one.share_over_150_us, one.share_over_1_ms) == (3 / 8, 1 / 8)
    nearest_rank = [np.percentile(late, share, method="inverted_cdf") for share in (99, 99.9)]
    assert (one.median_us, one.p99_us, one.p999_us) == (float(np.median(late)), *nearest_rank)
    assert (one.processor_share, one.polling_us) == (0.25, 70.0)
    assert one.over_blocks["mean_us"] == interval([mean(late[:4]), mean(late[4:])])
    assert (result.reference, one.ratios) == ("", {})


def test_conditions_are_divided_by_the_yardstick_block_by_block():
    found = settings(ROUND_ROBIN, C, iterations=6, blocks=3)
    own = [[1.0, 3.0], [2.0, 2.0], [6.0, 0.0]]
    other = [[10.0, 10.0], [40.0, 40.0], [5.0, 7.0]]
    blocks = [block(ROUND_ROBIN, number, late) for number, late in enumerate(own)]
    blocks += [block(C, number, late) for number, late in enumerate(other)]
    result = figures(found, blocks)
    ours, yardstick = result.conditions
    assert result.reference == "c"
    assert ours.ratios["mean_us"] == interval([0.2, 0.05, 0.5])
    assert yardstick.ratios == {}
    assert result.remarks == ("3 blocks give wide intervals; give --blocks 5 or more to compare",)


def test_what_was_broken_off_is_left_out_or_used_as_far_as_it_goes():
    found = settings(ROUND_ROBIN, C, blocks=5)
    broken = replace(block(C, 0, [5.0, 6.0]), cpu_ns=0, wall_ns=0)
    blocks = [block(ROUND_ROBIN, 0, [1.0]), broken, block(C, 1, [])]
    ours, yardstick = figures(found, blocks).conditions
    assert (ours.wake_ups, yardstick.wake_ups, yardstick.processor_share) == (1, 2, None)
    assert figures(found, [block(C, 1, [])]).conditions == ()
    only = figures(found, blocks[:1])
    assert (len(only.conditions), only.reference) == (1, "")
    assert only.remarks == ("1 block gives no interval; give --blocks 5 or more to compare",)


def test_a_block_that_was_broken_off_does_not_weigh_as_much_as_a_whole_one():
    found = settings(ROUND_ROBIN, C, iterations=6, blocks=3)
    rows = {ROUND_ROBIN: [1.0, 3.0], C: [4.0, 4.0]}
    blocks = [block(one, number, late) for one, late in rows.items() for number in (0, 1)]
    whole = figures(found, blocks).conditions
    cut = figures(found, [*blocks, block(C, 2, [900.0]), block(ROUND_ROBIN, 2, [1.0, 3.0])]).conditions
    for one, other in zip(whole, cut, strict=True):
        assert one.over_blocks["mean_us"].mean == other.over_blocks["mean_us"].mean
        assert one.ratios == other.ratios
    assert cut[1].max_us == 900.0
    # with nothing whole it is better than nothing
    assert figures(found, [block(C, 0, [7.0])]).conditions[0].over_blocks["mean_us"].mean == 7.0


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    found = settings(ROUND_ROBIN, C)
    blocks = [
        block(one, number, [1.5 + number, 20_000.0 - 100 * number])
        for number in (0, 1)
        for one in (ROUND_ROBIN, C)
    ]
    path = tmp_path_factory.mktemp("log") / "latency.mcap"
    summary = latency_log.write_log(path, found, blocks, "a load", ("a remark",))
    assert (summary.messages, summary.error) == (8, None)
    return path, found, blocks


def test_the_log_gives_the_same_result_again_and_other_tools_read_it(log):
    path, found, blocks = log
    read = open_log(path)
    assert latency_log.is_measurement(read)
    again, result = latency_log.measurement(read)
    for one, other in zip(again, blocks, strict=True):
        np.testing.assert_array_equal(one.times, other.times)
    assert result == figures(found, blocks, "a load", ("a remark",))
    assert latency_log.machine_of(read) == latency_log.machine()
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        rows = [
            (channel.topic, decoded.block, decoded.scheduled_ns, decoded.woken_ns)
            for _, channel, _, decoded in reader.iter_decoded_messages()
        ]
    assert sorted(rows) == sorted(
        (f"/latency/{one.condition}", one.number, *row) for one in blocks for row in one.times.tolist()
    )


def test_a_log_whose_description_is_damaged_is_one_sentence(log, tmp_path):
    def read(**other):
        return open_log(write_changed(log[0], tmp_path / "other.mcap", lambda read: replace(read, **other)))

    with pytest.raises(LogError, match="the details of the measurement cannot be read"):
        latency_log.measurement(read(metadata={"latency": {"about": "{"}}))
    with pytest.raises(LogError, match="the log has no wake-up"):
        latency_log.measurement(read(topics={}))
    topics = {name: topic for name, topic in read_log(log[0]).topics.items() if name != "/latency/c"}
    _, result = latency_log.measurement(read(topics=topics))
    assert [one.name for one in result.conditions] == ["round_robin"]


def test_the_page_has_the_tables_and_three_figures(log):
    _, found, blocks = log
    result = figures(found, blocks, "2 busy processes")
    first, second, *remarks = latency_tables.parts(result)
    assert isinstance(first, latency_tables.Table)
    assert isinstance(second, latency_tables.Table)
    assert first.title == "Wake-up latency, period 1 ms, 2 blocks; load: 2 busy processes"
    assert [column.name for column in first.columns] == ["", "round_robin", "c (round_robin)"]
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in first.rows}
    assert rows["maximum"] == ["20.00 ms", "20.00 ms"]
    assert rows["mode"] == ["1 us", "1 us"]
    assert rows["later than 1 ms"] == ["50.000%", "50.000%"]
    assert {row[0].text: row[1].text for row in second.rows}["mean, relative to c"] == "1 (1 to 1)"
    assert len(remarks) == 1
    text = page(result, blocks, "Linux <6>")
    assert "Linux &lt;6&gt;" in text
    assert text.count("<table>") == 2
    names = re.findall(r'<\w+ [^>]*\bid="([^"]+)"', text)
    assert {"plots", "report", "lateness", "latency-histogram", "latency-cumulative"} < set(names)
    assert len(names) == len(set(names))  # the script finds its plots by theirs
    written = re.sub("<script.*?</script>", "", text, flags=re.DOTALL)
    assert not re.search(r"""(?:src|href)=["'](?!#)""", written)
    (numbers,) = re.findall(r'<script type="application/json" id="report">(.*?)</script>', text, re.S)
    shown = json.loads(numbers)
    assert [one["name"] for one in shown["conditions"]] == ["round_robin", "c"]
    assert shown["conditions"][0]["mean_us"] == result.conditions[0].mean_us
