"""The shapes of the large needle driver.

All numbers are millimetres. The housing is drawn on the arm's carriage, in its frame (the base frame at home); every
other body in its link's own frame. Parts of the wrist lie side by side along the axis that they turn about:

    pitch axis (x): 0 pitch link 2.4 | 2.6 ears of the shaft;   yaw axis (y): 0 fingers 2.3 | 2.6 ears of the pitch link

The fingers open in x: finger 1 turns its tip toward -x.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import build123d as cad
from home_positions import home_positions
from shapes import Body, both, disc, fused, of, plate

SHAFT = 4.2  # radius


def insertion_link(_: float) -> Body:
    """Housing with the four discs that the arm's motors turn, and the levers that release it."""
    box = plate("z", 401, 472, [(x, y, 4) for x in (-20, 20) for y in (-3, 18)], 2.5)
    label = cad.Pos(0, 22, 446) * cad.Box(26, 1, 30)
    return [
        *of("casting", box),
        *of("graphite", plate("z", 469, 478, [(x, y, 4) for x in (-17, 17) for y in (0, 15)], 2), label),
        *of("cover", disc("z", 392, 403, 8, edge=1.5)),
        *of("rubber", both(lambda side: cad.Pos(side * 24.5, 6, 440) * cad.Box(3, 10, 34))),
        *of("steel", *(disc("y", -8, -5, 7, (z, x)) for z in (424, 446) for x in (-12, 12))),
    ]


def roll_link(housing: float) -> Body:
    """Shaft from inside the housing to the ears of the pitch axis."""
    inside = disc("z", -5, 9, SHAFT)
    ears = both(lambda side: plate("x", *sorted((side * 2.6, side * 4.2)), [(0, 0, 3.6), (0, 9, 4.2)]) & inside)
    return [
        *of("anodised", disc("z", 9, housing, SHAFT)),
        *of("steel", disc("z", 7.5, 10, SHAFT + 0.15), ears, disc("x", -4, 4, 1.2)),
    ]


def wrist_pitch_link(length: float) -> Body:
    """Pulley on the pitch axis and the two ears of the yaw axis, `length` below it."""
    inside = disc("z", -length - 5, 5, SHAFT)
    ears = both(
        lambda side: plate("y", *sorted((side * 2.6, side * 4.2)), [(-length, 0, 3.2), (-length + 5, 0, 3.6)]) & inside
    )
    neck = plate("x", -2.3, 2.3, [(0, 0, 3.5), (0, -3.2, 3.5)])
    yoke = disc("z", -length + 4.2, -3.8, SHAFT)
    return of("steel", neck.fuse(yoke), ears)


def wrist_yaw_link(_: float) -> Body:
    """Pin of both fingers."""
    return of("steel", disc("y", -4, 4, 1.2), disc("y", -0.35, 0.35, 2.6))


def finger(side: float) -> Body:
    """Hub beside the other finger's, jaw toward one side of x with a toothed insert on its face."""
    hub = plate("y", *sorted((side * 0.4, side * 2.3)), [(0, 0, 2.8), (-4.2, -side * 1.5, 1.3)])
    jaw = plate("y", -2.0, 2.0, [(-4.6, -side * 1.75, 1.35), (-11.2, -side * 1.15, 0.75)], 0.3)
    teeth = [cad.Pos(-side * 0.3, 0, z) * cad.Box(0.5, 3.2, 0.45) for z in (-5, -6, -7, -8, -9, -10, -11)]
    return [*fused("steel", hub, jaw), *of("aluminium", teeth)]


def finger_1_link(_: float) -> Body:
    """Opens toward -x."""
    return finger(1)


def finger_2_link(_: float) -> Body:
    """Opens toward +x."""
    return finger(-1)


def bodies(sdf: Path) -> dict[str, Callable[[], Body]]:
    """Returns the function that makes each link's body, by the link's name."""
    where = home_positions(sdf)
    pitch, yaw = where["wrist_pitch_link"][2], where["wrist_yaw_link"][2]
    return {
        "housing": partial(insertion_link, 0),
        "roll_link": partial(roll_link, 405 - where["roll_link"][2]),
        "wrist_pitch_link": partial(wrist_pitch_link, pitch - yaw),
        "wrist_yaw_link": partial(wrist_yaw_link, 0),
        "finger_1_link": partial(finger_1_link, 0),
        "finger_2_link": partial(finger_2_link, 0),
    }
