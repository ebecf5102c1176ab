"""How each fabric of ``material.PRESETS`` looks: colors of its sides, and the width of a stripe of its gingham."""

from __future__ import annotations

from typing import NamedTuple

from clothgym.render.shading import CORAL, INDIGO
from clothgym.render.solids import Color

PLAIN = 20.0  # width of a stripe that is wider than any sheet [m]


class Look(NamedTuple):
    """front, back: sRGB from 0 to 255; check: width of a stripe [m]."""

    front: Color
    back: Color
    check: float


LOOKS = {
    "median": Look((158, 152, 142), (120, 115, 108), 0.010),
    "cotton_broad": Look((64, 112, 170), (64, 112, 170), 0.020),
    "polyester_tropical": Look((30, 120, 116), (30, 120, 116), 0.004),
    "wool_tropical": Look((150, 104, 60), (120, 84, 50), 0.006),
    "polyester_faille": Look((150, 50, 96), (120, 40, 80), 0.003),
    "penava_cotton": Look(CORAL, INDIGO, 0.025),
    "knit": Look((70, 136, 70), (70, 136, 70), 0.012),
    "polyester": Look((104, 74, 150), (90, 64, 130), 0.002),
    "silk": Look((232, 196, 120), (232, 196, 120), PLAIN),
    "wool": Look((84, 80, 76), (84, 80, 76), 0.007),
    "denim": Look((46, 68, 122), (150, 166, 196), PLAIN),
}
LOOKS["cotton"] = LOOKS["cotton_broad"]
