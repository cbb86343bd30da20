"""`dxlrun reach`: a picture of the places that a link gets to."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Final

import numpy as np

from dxlrun import Floats, InputError
from dxlrun.tooling.output import check_target, show_parts, write_target
from dxlrun.tooling.verbs import Assignment, RobotPath, compiled, missing_extra
from dxlrun_space.chain import WrongChain, chain_of, spread
from dxlrun_space.pose_form import dexterity

POSTURES: Final = 20_000


def draw_reach(robot: RobotPath, tip: str, picture: Path, /, *assignments: Assignment, base: str = "") -> int:
    """Draw where a link gets to, from the side and from above, and how easily it moves there.

    Parameters
    ----------
    tip
        Link of the URDF.
    picture
        Output file: NAME.png or NAME.svg.
    base
        Link in whose axes places are. Default: the root.
    """
    if picture.suffix not in {".png", ".svg"}:
        raise InputError(f"{picture} is not a name for a picture; end it in .png or .svg")
    check_target(picture)
    if missing := missing_extra("a picture", "report", "matplotlib"):
        raise InputError(missing)
    plan = compiled(robot, assignments, (), None).plan
    limits = {joint.name: (joint.lower, joint.upper) for joint in plan.loop.joints}
    try:
        chain = chain_of(plan.urdf, base, tip)
    except WrongChain as wrong:
        raise InputError(str(wrong)) from None
    if lacking := next((joint for joint in chain.joints if joint not in limits), ""):
        fix = "run with it, or add it to `joints`"
        raise InputError(f"{tip} needs {lacking}, which is omitted or has no servo; {fix}")
    lower, upper = zip(*(limits[joint] for joint in chain.joints), strict=True)
    places, found = dexterity(chain, spread(lower, upper, POSTURES).tolist())
    places *= 1e3
    write_target(picture, _drawn(places, found, f"{tip} of {plan.robot}", picture.suffix[1:]))
    ends = zip("xyz", places.min(axis=0), places.max(axis=0), strict=True)
    show_parts(
        f"{tip}: {', '.join(f'{axis} {low:.0f}..{high:.0f} mm' for axis, low, high in ends)}; {picture}"
    )
    return 0


def _drawn(places: Floats, colours: Floats, title: str, form: str) -> bytes:
    from matplotlib.figure import Figure

    figure, content = Figure(figsize=(9, 4.2), layout="constrained"), io.BytesIO()
    figure.suptitle(title)
    both = figure.subplots(1, 2)
    for axes, name, y in zip(both, "zy", (places[:, 2], places[:, 1]), strict=True):
        cells = axes.hexbin(places[:, 0], y, colours, reduce_C_function=np.max, gridsize=45, vmin=0, vmax=1)
        axes.set(xlabel="x, mm", ylabel=f"{name}, mm", aspect="equal")
    figure.colorbar(cells, ax=both, label="best dexterity", shrink=0.8)
    figure.savefig(content, format=form, dpi=110)
    return content.getvalue()
