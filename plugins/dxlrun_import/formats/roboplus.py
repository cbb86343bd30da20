"""RoboPlus Motion: pages of a `.mtn` file, as a robot with a `keyframe_player` that has them.

Source: ROBOTIS' e-Manual ("RoboPlus Motion"), and arrays that users made of such files. `play_param` has next
page, exit page, repetitions, speed and inertial force. A step has a position for each entry of `enable` (the
first is not used), the pause and the time, s. Pages count from 1. Bit 14 marks a joint that a step does not
move [i: as in ROBOTIS' binary pages]. A compliance of 5 is a slope of 32, the default of an AX-12 [i: 1..7
are the slopes 2..128].
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions
from dxlrun_import.checked_values import refused, valid_name
from dxlrun_import.formats.roboplus_pages import BY_HAND, USUAL_COMPLIANCE, MotionPage, read_pages
from dxlrun_import.robot_draft import DraftBus, JointDraft, RobotDraft, wrapped

MIDDLE, STEP_DEG = 512, 300 / 1023  # of an AX-12
SPEED_DEG = 300.0  # mean speed: the peak of a cubic is 1.5 times as high, and an AX-12 reaches 472 deg/s
SHORTEST_S = 0.01  # of a step of a keyframe_player
_UNMOVED = 0x4000
_COMPLIANCES = range(1, 8)


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert the pages to motions of a `keyframe_player`, for joints that are named after their IDs."""
    flags, pages = read_pages(content)
    draft = RobotDraft(content, FORMAT.name, options.name)
    draft.buses["main"] = DraftBus(1.0, 1_000_000, comment="guessed: protocol and baud_rate of a Bioloid")
    used = [page for page in pages if page.steps]
    ids = [number for number, flag in enumerate(flags) if flag and number]
    for number in ids if used else ():
        for page in used:
            if any(1023 < step[number] < _UNMOVED for step in page.steps):
                what = f"a position of ID {number} is above 1023, so it is not an AX servo"
                raise refused(page.mark, what, BY_HAND)
        joint = JointDraft(f"joint_{number}", number, content.mark(), "AX-12A")
        if not varies(number, used):
            joint = joint._replace(registers=slopes_of(number, used[:1], draft))
        draft.add_joint(joint._replace(comment="guessed: name, model, direction"))
    for page in used:
        name = valid_name(page.title) if page.title else f"page_{page.number}"
        page.name = f"{name}_{page.number}" if any(name == one.name for one in used) else name
    for page in used:
        page.follower = _linked(page.param[0], pages)
    for page in used:
        _set_exit(page, _linked(page.param[1], pages), draft)
    lines = ["  pages:", "    type: keyframe_player"]
    lines += [*wrapped("    joints: [", [*draft.joints], "]"), "    motions:"]
    for page in used:
        before = [
            one for one in used if page in (one.follower, one.exit) or (one is page and page.param[2] > 1)
        ]
        slopes = {one: slopes_of(one, [page], draft, usual=True) for one in ids if varies(one, used)}
        lines += motion_lines(page, ids, [one.steps[-1] for one in before], slopes, draft)
    draft.controllers = lines
    return draft.conversion()


def _linked(number: float, pages: Sequence[MotionPage]) -> MotionPage | None:
    """Return the page with a number; None if it has no steps or does not exist."""
    return pages[int(number) - 1] if 0 < number <= len(pages) and pages[int(number) - 1].steps else None


def _set_exit(page: MotionPage, leaves: MotionPage | None, draft: RobotDraft) -> None:
    """Set the exit of a page, unless it closes a circle of exits, after which a stop would never end."""
    way = leaves
    while way is not None and way is not page:
        way = way.exit
    if way is None:
        page.exit = leaves
    else:
        draft.remarks.append(f"page {page.name}: its exit page {int(page.param[1])}, which leads back to it")


def varies(number: int, used: Sequence[MotionPage]) -> bool:
    """Return True if pages have different compliances of a joint. Each page then sets its own."""
    return len({page.compliance_of(number) for page in used}) > 1


def slopes_of(
    number: int, pages: Sequence[MotionPage], draft: RobotDraft, usual: bool = False
) -> dict[str, int]:
    """Return the registers for the compliance of a joint in a page; for the usual one only with `usual`."""
    found = next((page.compliance_of(number) for page in pages), USUAL_COMPLIANCE)
    if found == USUAL_COMPLIANCE and not usual:
        return {}
    if found not in _COMPLIANCES:
        draft.remarks.append(f"joint_{number}: compliance {found:g}; write `registers` of the joint")
        return {}
    return dict.fromkeys(("cw_compliance_slope", "ccw_compliance_slope"), 1 << int(found))


def motion_lines(
    page: MotionPage,
    ids: Sequence[int],
    starts: list[list[float]],
    slopes: Mapping[int, Mapping[str, int]],
    draft: RobotDraft,
    *,
    fastest: float = SPEED_DEG,
) -> Iterator[str]:
    """Yield the lines of a page.

    Args:
        page: The page.
        ids: IDs of the servos.
        starts: Poses from which it is reached.
        slopes: Registers of its first step, by ID.
        draft: Collects the remarks.
        fastest: Highest mean speed of the servos, deg/s.
    """
    _, _, repeat, speed, _ = page.param
    if speed <= 0:
        raise refused(page.mark, f"page {page.name} has speed {speed:g}", "give it a speed above 0")
    remarks: list[str] = []
    yield f"      {page.name}:"
    yield from [f"        speed: {speed:g}"] * (speed != 1)
    yield from [f"        repeat: {int(repeat)}"] * (repeat > 1)
    yield from [f"        next: {one.name}" for one in (page.follower,) if one]
    yield from [f"        exit: {one.name}" for one in (page.exit,) if one]
    yield "        steps:"
    for index, step in enumerate(page.steps, 1):
        moved = [one for one in ids if step[one] < _UNMOVED]
        pose = [f"joint_{one}: {round((step[one] - MIDDLE) * STEP_DEG, 2) + 0.0:g} deg" for one in moved]
        ways = [abs(step[one] - start[one]) for start in starts for one in moved if start[one] < _UNMOVED]
        least = max(SHORTEST_S, math.ceil(max(ways, default=0) * STEP_DEG * speed / fastest * 1000) / 1000)
        if step[-1] < least:
            remarks.append(f"step {index} takes {least:g} s instead of {step[-1]:g} s, as fast as its servos")
        start = f"          - {{time: {max(step[-1], least):g} s, pause: {step[-2]:g} s, pose: {{"
        registers = [
            f"joint_{one}: {{{', '.join(f'{item}: {value}' for item, value in written.items())}}}"
            for one, written in slopes.items()
            if written
        ]
        if index == 1 and registers:
            yield from wrapped(start, pose, "},")
            yield from wrapped("             registers: {", registers, "}}")
        else:
            yield from wrapped(start, pose, "}}")
        starts = [step]
    draft.remarks += [f"page {page.name}: {remark}" for remark in remarks]


def _matches(content: FileContent) -> bool:
    data = content.data.removeprefix(b"\xef\xbb\xbf")
    return data.startswith(b"type=motion") or b"\npage_begin\n" in data.replace(b"\r", b"")


FORMAT = FileFormat("a motion file of RoboPlus", _matches, convert=f"{__name__}:convert")
