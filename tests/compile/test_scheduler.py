"""What the robot file wishes from the operating system, and how fast the buses let the loop become."""

import pytest
from tests.kit.robots import PAIR, compile_text

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


@pytest.mark.parametrize(
    ("wish", "plan_ns"), [("auto", None), ("off", 0), ("250 us", 250_000)], ids=["auto", "off", "duration"]
)
def test_how_long_replies_are_polled_for_is_handed_to_the_loop(wish, plan_ns):
    text = with_loop(PAIR, f"{{rate: 50, scheduler: {{reply_polling: {wish}}}}}")
    assert compile_text(text).plan.loop.scheduler.reply_polling_ns == plan_ns
