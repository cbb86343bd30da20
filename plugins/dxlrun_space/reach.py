"""`dxlrun reach`: a picture of the places that a link gets to."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from dxlrun import Floats, InputError
from dxlrun.tooling.output import check_target, show_parts, write_target
from dxlrun.tooling.robots import read_urdf
from dxlrun.tooling.verbs import Assignment, RobotPath, compiled, missing_extra
from dxlrun_space.chain import Chain, WrongChain, chain_of, spread

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
        chain = chain_of(None if plan.urdf is None else read_urdf(plan.urdf), base, tip, limits)
    except WrongChain as wrong:
        raise InputError(str(wrong)) from None
    lower, upper = zip(*(limits[joint] for joint in chain.joints), strict=True)
    places, found = dexterity(chain, spread(lower, upper, POSTURES).tolist())
    places *= 1e3
    write_target(picture, _drawn(places, found, f"{tip} of {plan.robot}", picture.suffix[1:]))
    ends = zip("xyz", places.min(axis=0), places.max(axis=0), strict=True)
    show_parts(
        f"{tip}: {', '.join(f'{axis} {low:.0f}..{high:.0f} mm' for axis, low, high in ends)}; {picture}"
    )
    return 0


def dexterity(chain: Chain, postures: Iterable[Sequence[float]]) -> tuple[Floats, Floats]:
    """Return place and dexterity of the tip at joint positions: 1 in all directions alike, 0 singular.

    This is the inverse condition number of the Jacobian of the tip's place (J. K. Salisbury and J. J. Craig,
    "Articulated hands: force control and kinematic issues", 1982).
    """
    places, columns = [], []
    for posture in postures:
        places.append(chain.pose(posture).translation)
        columns.append([column[:3] for column in chain.jacobian()])
    speeds = np.linalg.svd(np.array(columns), compute_uv=False)
    return np.array(places), speeds[:, -1] / np.maximum(speeds[:, 0], 1e-12)


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
