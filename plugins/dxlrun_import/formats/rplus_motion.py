"""R+ Motion: pages and flows of a `.mtnx` file, as a robot with a `keyframe_player` that has them.

Source: ROBOTIS' e-Manual ("R+ Motion 2.0"), and files that users published. A step has a position of each
joint of `skeleton`, degrees from the middle of its servo, and a frame since the start of its page, 1/128 s
[i]. A unit of a flow plays a page `loop` times at a speed, and at a stop its exit page.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions
from dxlrun_import.checked_values import refused, valid_name
from dxlrun_import.formats.roboplus import MIDDLE, STEP_DEG, motion_lines, slopes_of
from dxlrun_import.formats.roboplus_pages import BY_HAND, USUAL_COMPLIANCE, MotionPage
from dxlrun_import.robot_draft import DraftBus, JointDraft, RobotDraft, wrapped

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_FRAME_S = 1 / 128
_MODELS = {
    "AX-12": "AX-12A",
    "AX-12+": "AX-12A",
    "XL320": "XL-320",
}  # names of R+ Motion; others are the usual ones
_OLD = ("AX", "RX", "EX", "DX", "MX")  # Protocol 1.0, at least as shipped
_SMOOTH = 1.55  # ratio of the peak to the mean speed of a cubic, with some reserve


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert pages and flows to motions of a `keyframe_player`; joints are named after their IDs."""
    draft = RobotDraft(content, FORMAT.name, options.name)
    ids = [int(_number(content, joint, "id")) for joint in content.xml.iter("joint")]
    used = _add_joints(content, draft)
    pages = [
        page
        for number, element in enumerate(content.xml.iter("Page"), 1)
        if (page := _page(content, element, number, ids)).steps
    ]
    named: dict[str, MotionPage] = {}
    for page in pages:
        named.setdefault(page.title, page)
    motions = [*pages, *_flows(content, named, draft)]
    for page in motions:
        name = valid_name(page.title) if page.title else f"page_{page.number}"
        taken = {one.name for one in motions}
        numbered = (f"{name}_{number}" for number in itertools.count(2))
        page.name = name if name not in taken else next(one for one in numbered if one not in taken)
    tables = [table for joint in draft.joints.values() if (table := draft.control_table(joint))]
    fastest = min((math.degrees(table.top_speed) for table in tables), default=math.inf) / _SMOOTH
    unusual = [one for one in used if any(page.compliance_of(one) != USUAL_COMPLIANCE for page in pages)]
    if unusual and not all("cw_compliance_slope" in table.items for table in tables):
        draft.remarks.append("softness of the pages: write `registers` with gains into their first steps")
        unusual = []
    lines = ["  pages:", "    type: keyframe_player"]
    lines += [*wrapped("    joints: [", [*draft.joints], "]"), "    motions:"]
    for page in motions:
        before = [one.steps[-1] for one in motions if page in (one.follower, one.exit)]
        before += [page.steps[-1]] * (page.param[2] > 1)
        slopes = {one: slopes_of(one, [page], draft, usual=True) for one in unusual}
        lines += motion_lines(page, used, before, slopes, draft, fastest=fastest)
    draft.controllers = lines
    return draft.conversion()


def _add_joints(content: FileContent, draft: RobotDraft) -> list[int]:
    """Add the joints that are enabled to the draft, and return their IDs."""
    enabled = [joint for joint in content.xml.iter("joint") if joint.get("enable", "True").lower() == "true"]
    models = [_MODELS.get(name, name) for joint in enabled for name in (joint.get("motor", ""),)]
    old = {model.startswith(_OLD) for model in models}
    if len(old) > 1:
        what = f"it has servos of both protocols: {', '.join(sorted({*models}))}"
        raise content.refusal(what, BY_HAND)
    comment = "guessed: protocol and baud_rate, those of new servos"
    draft.buses["main"] = DraftBus(1.0 if True in old else 2.0, 1_000_000, comment=comment)
    for joint, model in zip(enabled, models, strict=True):
        number = int(_number(content, joint, "id"))
        mark = content.mark_of(joint)
        draft.add_joint(
            JointDraft(f"joint_{number}", number, mark, model, comment="guessed: name, direction")
        )
    return [joint.id for joint in draft.joints.values()]


def _page(content: FileContent, element: Element, number: int, ids: Sequence[int]) -> MotionPage:
    """Return a page in the form of RoboPlus: ticks by ID, pause and time, s. Raises InputError."""
    page = MotionPage(content.mark_of(element), number, element.get("name", ""))
    most = max(ids, default=0) + 1
    param = element.find("param")
    softness = [] if param is None else _numbers(content, param, "softness", None)
    compliance = [float(USUAL_COMPLIANCE)] * most
    for servo_id, value in zip(ids, softness, strict=False):
        compliance[servo_id] = value
    page.compliance = compliance
    before = 0.0
    for step in element.iter("step"):
        frame = _number(content, step, "frame")
        if frame < before or (page.steps and frame == before):
            raise refused(
                content.mark_of(step), f"frame {frame:g} is not after {before:g}", "export it again"
            )
        ticks = [float(MIDDLE)] * most
        for servo_id, angle in zip(ids, _numbers(content, step, "pose", len(ids)), strict=True):
            ticks[servo_id] = MIDDLE + angle / STEP_DEG
        page.steps.append([*ticks, 0.0, (frame - before) * _FRAME_S])
        before = frame
    return page


def _flows(content: FileContent, pages: dict[str, MotionPage], draft: RobotDraft) -> list[MotionPage]:
    """Return a motion for each unit of the flows, each followed by the next one."""
    found: list[MotionPage] = []
    for flow in content.xml.iter("Flow"):
        before: MotionPage | None = None
        for unit in flow.iter("unit"):
            page = pages.get(unit.get("main", ""))
            if page is None:
                draft.remarks.append(f"flow {flow.get('name')}: {unit.get('main')!r}, no page with steps")
                continue
            param = (0, 0, _number(content, unit, "loop"), _number(content, unit, "mainSpeed"), 32)
            one = MotionPage(
                content.mark_of(unit), 0, flow.get("name", ""), page.compliance, param, page.steps
            )
            one.exit = pages.get(unit.get("exit", ""))
            if before is not None:
                before.follower = one
            before = one
            found.append(one)
        if before is not None and flow.get("return", "-1") != "-1":
            draft.remarks.append(f"flow {flow.get('name')}: its return; write `next` of {before.title}")
    return found


def _number(content: FileContent, element: Element, key: str) -> float:
    return _numbers(content, element, key, 1)[0]


def _numbers(content: FileContent, element: Element, key: str, count: int | None) -> list[float]:
    text = element.get(key, "")
    try:
        found = [float(word) for word in text.split()]
    except ValueError:
        found = [math.nan]
    mark = content.mark_of(element)
    if not all(map(math.isfinite, found)):
        raise refused(mark, f"{key} {text:.40} is not a list of numbers", "export the file again")
    if count not in (None, len(found)):
        what = f"{key} has {len(found)} numbers, but must have {count}"
        raise refused(mark, what, "export the file again")
    return found


def _matches(content: FileContent) -> bool:
    return content.top == "Root" and content.xml.find("PageRoot") is not None


FORMAT = FileFormat("a motion file of R+ Motion", _matches, convert=f"{__name__}:convert")
