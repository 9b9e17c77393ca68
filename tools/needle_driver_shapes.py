"""Shapes of the large needle driver.

All numbers are millimetres. The housing is fixed to the carriage of the arm. Its coordinates are in the frame of the
carriage, which coincides with the base frame in the home pose. The coordinates of each other body are in the frame of
its link. Parts of the wrist lie side by side along their axis of rotation:

    pitch axis (x): 0 pitch link 2.4 | 2.6 ears of the shaft
    yaw axis (y):   0 fingers 2.3    | 2.6 ears of the pitch link

The fingers open in x. Finger 1 moves its tip toward -x.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import build123d as cad
from home_positions import home_positions
from shapes import Body, both, disc, fused, made_of, plate

SHAFT = 4.2  # radius


def insertion_link(_: float) -> Body:
    """Returns the housing with the four discs that the motors of the arm drive, and its release levers."""
    box = plate("z", 401, 472, [(x, y, 4) for x in (-20, 20) for y in (-3, 18)], 2.5)
    label = cad.Pos(0, 22, 446) * cad.Box(26, 1, 30)
    return [
        *made_of("casting", box),
        *made_of("graphite", plate("z", 469, 478, [(x, y, 4) for x in (-17, 17) for y in (0, 15)], 2), label),
        *made_of("cover", disc("z", 392, 403, 8, edge=1.5)),
        *made_of("rubber", both(lambda side: cad.Pos(side * 24.5, 6, 440) * cad.Box(3, 10, 34))),
        *made_of("steel", *(disc("y", -8, -5, 7, (z, x)) for z in (424, 446) for x in (-12, 12))),
    ]


def roll_link(housing: float) -> Body:
    """Returns the shaft from inside the housing to the ears of the pitch axis."""
    inside = disc("z", -5, 9, SHAFT)
    ears = both(lambda side: plate("x", *sorted((side * 2.6, side * 4.2)), [(0, 0, 3.6), (0, 9, 4.2)]) & inside)
    return [
        *made_of("anodised", disc("z", 9, housing, SHAFT)),
        *made_of("steel", disc("z", 7.5, 10, SHAFT + 0.15), ears, disc("x", -4, 4, 1.2)),
    ]


def wrist_pitch_link(length: float) -> Body:
    """Returns the pulley on the pitch axis and the two ears of the yaw axis, which is `length` below the pitch axis."""
    inside = disc("z", -length - 5, 5, SHAFT)
    ears = both(
        lambda side: plate("y", *sorted((side * 2.6, side * 4.2)), [(-length, 0, 3.2), (-length + 5, 0, 3.6)]) & inside
    )
    neck = plate("x", -2.3, 2.3, [(0, 0, 3.5), (0, -3.2, 3.5)])
    yoke = disc("z", -length + 4.2, -3.8, SHAFT)
    return made_of("steel", neck.fuse(yoke), ears)


def wrist_yaw_link(_: float) -> Body:
    """Returns the pin of both fingers."""
    return made_of("steel", disc("y", -4, 4, 1.2), disc("y", -0.35, 0.35, 2.6))


def finger(side: float) -> Body:
    """Returns a finger: hub beside the other finger, and jaw on one side of x with a toothed insert."""
    hub = plate("y", *sorted((side * 0.4, side * 2.3)), [(0, 0, 2.8), (-4.2, -side * 1.5, 1.3)])
    jaw = plate("y", -2.0, 2.0, [(-4.6, -side * 1.75, 1.35), (-11.2, -side * 1.15, 0.75)], 0.3)
    teeth = [cad.Pos(-side * 0.3, 0, z) * cad.Box(0.5, 3.2, 0.45) for z in (-5, -6, -7, -8, -9, -10, -11)]
    return [*fused("steel", hub, jaw), *made_of("aluminium", teeth)]


def finger_1_link(_: float) -> Body:
    """Returns the finger that opens toward -x."""
    return finger(1)


def finger_2_link(_: float) -> Body:
    """Returns the finger that opens toward +x."""
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
