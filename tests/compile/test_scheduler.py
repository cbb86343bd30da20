# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""What the robot file wishes from the operating system, and how fast the buses let the loop become."""

import pytest
from tests.kit.robots import PAIR, compile_text, problems_in

WISHES = "{policy: fifo, priority: 40, cores: [1, 3], polling: 250 us, idle_latency: true}"


def with_loop(text, loop):
    return text.replace("loop: {rate: 50}", f"loop: {loop}")


def test_every_wish_reaches_the_plan():
    text = with_loop(PAIR, f"{{rate: 50, overrun: catch_up, scheduler: {WISHES}}}")
    loop = compile_text(text).plan.loop
    wish = loop.scheduler
    assert (wish.policy, wish.priority, wish.cores) == ("fifo", 40, (1, 3))
    assert (wish.polling_ns, wish.idle_latency) == (250_000, True)
    assert loop.overrun == "catch_up"


def test_without_a_wish_nothing_is_asked_for():
    loop = compile_text(PAIR).plan.loop
    wish = loop.scheduler
    assert (wish.policy, wish.cores, wish.polling_ns, wish.idle_latency) == ("other", (), None, False)
    assert loop.overrun == "skip"


def test_polling_may_be_left_to_the_measurement():
    text = with_loop(PAIR, "{rate: 50, scheduler: {polling: auto}}")
    assert compile_text(text).plan.loop.scheduler.polling_ns is None


def test_the_slowest_bus_says_how_short_a_period_may_become():
    two = PAIR.replace(
        "loop:",
        "  slow: {port: /dev/ttyUSB1, protocol: 1.0, baud_rate: 57_600, adapter: {latency: 1 ms}}\nloop:",
    ).replace("    bus: main\n    id: 2", "    bus: slow\n    id: 2")
    plan = compile_text(two).plan
    fast, slow = (bus.budget.total_ns for bus in plan.buses)
    assert plan.loop.least_period_ns == slow > fast


def test_the_rate_of_the_file_is_always_possible():
    total_ns = compile_text(PAIR).plan.buses[0].budget.total_ns
    rate = 1e9 / total_ns
    loop = compile_text(with_loop(PAIR, f"{{rate: {rate!r}}}").replace(", rate: 25", "")).plan.loop
    assert loop.least_period_ns <= loop.period_ns


CORES = "loop.scheduler.cores: cores are given once each, and at least one; write for example [3]"


@pytest.mark.parametrize(
    ("loop", "told"),
    [
        ("{rate: 50, scheduler: {polling: 12 ms}}", "4:39: polling 12 ms is over half of the period, 20 ms; write less, or auto"),
        ("{rate: 50, scheduler: {policy: fifo, priority: 99}}", "4:54: warning: priority 99 leaves none above it for the guardian; write 98 at most"),
        ("{rate: 50, scheduler: {cores: [2, 2]}}", f"4:37: {CORES}"),
        ("{rate: 50, scheduler: {cores: []}}", f"4:37: {CORES}"),
        ("{rate: 50, scheduler: {cores: [-1]}}", "4:38: loop.scheduler.cores[0] is -1, but must be at least 0; correct it"),
        ("{rate: 50, scheduler: {polling: often}}", "4:39: loop.scheduler.polling: 'often' is not a duration; write a duration such as 500 us, 1 ms, 2 s or 1 min, or auto"),
        ("{rate: 50, overrun: later}", "4:27: loop.overrun is the text 'later', but must be skip, catch_up or stop; write it so"),
    ],
)  # fmt: skip
def test_a_wish_that_cannot_be_is_told_with_its_place(loop, told):
    assert [str(one).split("robot.yaml:")[1] for one in problems_in(with_loop(PAIR, loop))] == [told]


def test_a_rate_at_which_nobody_can_stop_the_loop_in_time_is_a_warning():
    (warning,) = problems_in(with_loop(PAIR, "{rate: 0.25}").replace(", rate: 25", ""))
    assert str(warning).split("robot.yaml:")[1] == (
        "4:14: warning: at 0.25 Hz a request to stop is seen up to 4 s late, when the guardian has "
        "ended the loop, as exit_timeout is 2 s; raise policies.exit_timeout, or the rate"
    )


@pytest.mark.parametrize(
    ("wish", "plan_ns"), [("auto", None), ("off", 0), ("250 us", 250_000)], ids=["auto", "off", "duration"]
)
def test_how_long_replies_are_polled_for_is_handed_to_the_loop(wish, plan_ns):
    text = with_loop(PAIR, f"{{rate: 50, scheduler: {{reply_polling: {wish}}}}}")
    assert compile_text(text).plan.loop.scheduler.reply_polling_ns == plan_ns
