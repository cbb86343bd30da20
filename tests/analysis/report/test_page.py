"""Analysis: the page of a report is well-formed, self-contained, complete, and says the report's numbers."""

import json
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from tests.kit.made_logs import Cycle, Said, Wire, made_log

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.log import log_reader, log_writer
from dxlrun.log.log_reader import Log, LogReader, open_log, read_log
from dxlrun.output.json import json_text
from dxlrun_analysis.page.report_page import analyzed_page
from dxlrun_analysis.report import analyze, tables
from dxlwire.packets import PacketKind

pytestmark = pytest.mark.long

_VOID = {"meta", "br", "img", "input", "link", "hr"}


class Reader(HTMLParser):
    """Reads a page; fails where an element is not closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.texts: dict[str, list[str]] = {}
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, key, value or "") for key, value in attrs]
        self.ids += [value or "" for key, value in attrs if key == "id"]
        if tag not in _VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.setdefault(self.open[-1] if self.open else "", []).append(data)

    def words(self, *tags: str) -> list[str]:
        return [text for tag in tags for text in self.texts.get(tag, [])]


Made = tuple[str, Reader]


def data(text: str, name: str) -> Any:
    """Return the JSON in the element of a page with this identifier."""
    (inside,) = re.findall(rf'<script type="application/json" id="{name}">(.*?)</script>', text, re.DOTALL)
    return json.loads(inside)


def made(log: Log | LogReader) -> Made:
    text = analyzed_page(log)[1]
    return text, Reader(text)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with everything in it: late and skipped cycles, a lost reply, an error, a clamp, a fault."""
    rng = np.random.default_rng(3)
    cycles = [
        Cycle(number, late=int(rng.exponential(8)), position=0.3 * np.sin(number / 20), goal=0.31)
        for number in range(200)
    ]
    cycles += [Cycle(203, skipped=3, late=900, read=23_000, valid=False, clamped=2)]
    ask, answer = bytes.fromhex("ffff0504022406ca"), bytes.fromhex("ffff05082000020000000000f0")
    packets = [
        Wire(PacketKind.INSTRUCTION, 5, 0, ask),
        Wire(PacketKind.STATUS, 5, 640, answer),
        Wire(PacketKind.INSTRUCTION, 5, 1000, ask),
    ]
    events = [
        Said(EventCode.SCHEDULER, Severity.INFO, "timer slack 1 ns"),
        Said(EventCode.SCHEDULER, Severity.WARNING, "scheduler fifo 31 was refused"),
        Said(EventCode.SCHEDULER, Severity.INFO, "all memory is locked", "guardian"),
        Said(EventCode.CONTROLLER_FAULT, Severity.ERROR, "</script><b>ValueError</b> & \x1b[31m"),
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log_writer, "CHUNK_BYTES", 1000)
        return made_log(tmp_path_factory.mktemp("run"), cycles, packets, events)


@pytest.fixture(scope="module")
def whole(run):
    """The page of the log, which is read in slices."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log_reader, "SLICE_BYTES", 1)
        assert sum(1 for _ in open_log(run).slices()) > 2
        return made(open_log(run))


def without_library(text: str) -> str:
    """Return a page without the script of the plots; a test in a browser sees that it loads nothing."""
    scripts = re.findall(r"<script>.*?</script>", text, re.DOTALL)
    assert len(scripts) == 2
    return text.replace(max(scripts, key=len), "")


def test_the_page_of_a_log_read_in_slices_is_that_of_the_whole(run, whole):
    assert whole[0] == analyzed_page(read_log(run))[1]


def test_the_page_is_well_formed_and_loads_nothing(whole):
    text, reader = without_library(whole[0]), whole[1]
    assert text.startswith("<!DOCTYPE html>")
    assert "http://" not in text
    assert "https://" not in text
    loading = {"src", "srcset", "data", "action", "poster", "background"}
    assert not [(tag, key) for tag, key, _ in reader.attributes if key in loading]
    assert all(value.startswith("#") for _, key, value in reader.attributes if key.endswith("href"))
    assert not re.search(r"@import|url\((?!#)", text)
    assert "link" not in {tag for tag, _, _ in reader.attributes}


def test_references_inside_the_page_find_exactly_one_place(whole):
    _, reader = whole
    assert len(reader.ids) == len(set(reader.ids))
    wanted = {value[1:] for _, key, value in reader.attributes if key.endswith("href")}
    assert wanted
    assert wanted <= set(reader.ids)


def test_each_plot_has_a_place_with_words_for_readers_who_cannot_see_it(whole):
    text, reader = whole
    plots = data(text, "plots")
    (items,) = plots["items"]
    places = set(items["roots"].values())
    assert len(places) >= 10
    assert places == {name for name in reader.ids if name.startswith("plot-")}
    assert list(items["roots"]) == items["root_ids"]
    assert {root["id"] for root in plots["documents"]["run"]["roots"]} == set(items["roots"])
    labels = [value for tag, key, value in reader.attributes if key == "aria-label" and tag == "div"]
    assert len(labels) == len(places)
    assert all(len(label) > 10 for label in labels)


def test_the_plots_of_each_joint_and_of_the_thesis_are_there_in_degrees(run, whole):
    text, reader = whole
    joints, titles = read_log(run).joints, reader.words("h3")
    assert [title for title in titles if title in joints] == list(joints)
    assert text.count('"position, deg"') == len(joints)
    assert '"velocity, deg/s"' not in text  # none was read or sent
    assert {"no reply", "clamped"} <= set(reader.words("button"))
    assert {
        "Wake-up latency",
        "Histogram of the wake-ups up to 150 us",
        "Cumulative distribution of the wake-ups",
        "Budget of a cycle",
        "Events over the run",
    } <= set(titles)
    assert '"99 %"' in text
    assert not re.search(r"\brad\b", " ".join(reader.words("caption", "figcaption", "td", "th", "p")))
    assert not re.search(r'"[a-z ]+, rad(/s)?"', text)


def test_the_numbers_are_those_of_the_report(run, whole):
    text, reader = whole
    report = analyze(read_log(run))
    assert data(text, "report") == json.loads(json_text(report.numbers))
    shown = reader.words("td", "th")
    for table in tables(report).values():
        assert table.title in reader.words("caption")
        for row in table.rows:
            for cell in row:
                assert cell.text.strip().replace("\x1b", "\\x1b") in shown
    for finding in report.verdict.findings:
        sentence = finding.sentence.replace("\x1b", "\\x1b")
        assert sentence in [text.strip() for text in reader.words("p", "h1")]
        assert not finding.remedy or finding.remedy in reader.words("strong")


def test_the_robot_comes_first_and_the_machine_is_folded_at_the_end(run, whole):
    text, reader = whole
    line = analyze(read_log(run)).verdict.findings[0].sentence
    assert line.startswith("Not good: ")
    assert reader.words("h1") == [line]
    assert text.index(f"<h1>{line}") < text.index("<p") < text.index('id="joints"')
    sections = re.findall(r'<section id="(\w+)"><(\w+)>', text)
    assert sections[0] == ("joints", "h2")
    assert sections[-1] == ("machine", "details")
    assert {tag for _, tag in sections[:-1]} == {"h2"}
    assert text.index("<details>") < text.index("<caption>Run<")


def test_findings_lead_to_their_plots(whole):
    text, reader = whole
    found = re.findall(r'<p>([^<]+)[^\n]*?<a href="#([^"]+)">', text.partition("<dl")[0])
    plots = {words.split(":")[0]: plot for words, plot in found}
    assert plots["Servos reported errors"] == "events-timeline"
    assert plots["The loop kept 50 Hz"] == "lateness"
    assert set(plots.values()) <= set(reader.ids)


def test_what_was_asked_of_the_system_and_granted_is_reported(whole):
    _, reader = whole
    cells = reader.words("th", "td")
    assert cells.count("granted") == 1
    assert cells.count("not granted") == cells.count("granted to the guardian") == 1
    assert "scheduler fifo 31 was refused" in cells


def test_a_text_from_the_log_stays_a_text(whole):
    text, reader = without_library(whole[0]), whole[1]
    assert "<b>" not in text
    assert "\x1b" not in text
    assert "</script><b>ValueError</b> & \\x1b[31m" in reader.words("td")


def test_a_log_of_nothing_but_nan_and_one_that_is_cut_give_a_page(write, run, tmp_path):
    nan = float("nan")
    _, reader = made(read_log(write([Cycle(n, position=nan, goal=nan, valid=False) for n in range(3)])))
    assert "No goal was sent, or no position was read." in reader.words("figcaption")
    cut, data = tmp_path / "cut.mcap", run.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    _, reader = made(read_log(cut))
    assert any("ends early" in text or "cannot be read" in text for text in reader.words("p"))
