"""Shapes of the links of the MTM.

All numbers are millimetres in the link frame: +X to the operator's left, +Y toward the operator, +Z up. The lengths
between joints are read from mtmr.sdf. The links lie in parallel planes. The ranges of their parts along x are:

    -56 yoke | -34 pulleys, cables -27 | -25 arm 25 | 28 crank 37 | 39 coupler 47 | 56 yoke

The brackets of the wrist lie in spherical shells around the wrist centre, so that they do not collide. The radii of the
shells are:

    handle < 56 | yaw 56..72 | pitch 72..104 | platform > 105
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import atan2, cos, hypot, sin
from pathlib import Path

import build123d as cad
from home_positions import home_positions
from shapes import Body, bolts, disc, fused, made_of, plate, swept


@dataclass(frozen=True)
class Lengths:
    """Distances between joints in millimetres."""

    upper_arm: float
    forearm: float
    rise: float  # from the end of the forearm to the wrist centre
    crank: float

    @classmethod
    def read(cls, sdf: Path) -> "Lengths":
        """Reads the lengths from the positions of the links in the home pose, in which the links are not rotated."""
        where = home_positions(sdf)
        platform, wrist = where["platform_link"], where["wrist_pitch_link"]
        return cls(-where["forearm_link"][2], -platform[1], wrist[2] - platform[2], -where["coupler_link"][1])


def base_link(_: Lengths) -> Body:
    """Returns the mounting plate, the fixed half of the round yaw housing, and the motor above it."""
    corners = [(x, y, 16) for x in (-74, 74) for y in (-74, 74)]
    return [
        *made_of("casting", plate("z", 318, 330, corners, 3), disc("z", 291, 320, 76, edge=4)),
        *made_of("cover", disc("z", 287, 292, 70), disc("z", 330, 388, 33, edge=9), disc("z", 330, 336, 45, edge=2)),
        *made_of("steel", bolts("z", 329, 334, 92, 4, 6)),
        *made_of("steel", bolts("z", 335, 338, 39, 6, 2.5)),
    ]


def outer_yaw_link(_: Lengths) -> Body:
    """Returns the rotating half of the yaw housing, and the yoke that holds the shoulder on both sides."""
    top, side, bend = 236.0, 65.0, 54.0
    arch = cad.FilletPolyline((-side, 0, 0), (-side, 0, top), (0, 0, top), radius=bend)
    half = swept(arch.wire(), (-1, 0, 0), (44, 16, 7), (66, 17, 7), (92, 18, 7))
    yoke = half.fuse(half.mirror(cad.Plane.YZ))
    ends = [disc("x", low, low + 20, 37, edge=5) for low in (-76, 56)]
    neck = cad.Pos(0, 0, 240) * cad.Cone(50, 76, 20, align=(cad.Align.CENTER, cad.Align.CENTER, cad.Align.MIN))
    covers = [disc("x", -88, -74, 29, edge=5), disc("x", 74, 92, 29, edge=6)]
    return [
        *fused("casting", yoke, *ends, neck, disc("z", 258, 286, 76, edge=4)),
        *made_of("cover", *covers),
        *made_of("steel", disc("x", -57, -36, 14), disc("x", 38.5, 57, 14)),
        *made_of("steel", bolts("x", -77.5, -75, 33, 6, 2.2), bolts("x", 75, 77.5, 33, 6, 2.2)),
    ]


def pulley(low: float, radius: float) -> Body:
    """Returns a grooved cable pulley on the x axis with a width of 7 mm."""
    wheel = disc("x", low, low + 2, radius, edge=0.6).fuse(
        disc("x", low + 5, low + 7, radius, edge=0.6), disc("x", low + 1, low + 6, radius - 3)
    )
    for hole in bolts("x", low - 1, low + 8, 0.68 * radius, 6, 0.17 * radius):
        wheel = wheel.cut(hole)
    return [*made_of("steel", wheel), *made_of("cover", disc("x", low - 1.6, low + 1, 0.4 * radius, edge=1))]


def upper_arm_link(lengths: Lengths) -> Body:
    """Returns the motors above the shoulder, the tube with two cables beside it, and the eye at the elbow."""
    elbow = -lengths.upper_arm
    pack = plate("x", -48, 48, [(-15.5, 154, 38), (-15.5, 167, 38)], 13)
    hub = plate("x", -25, 26, [(0, 0, 36), (-13, 125, 28)], 10)
    eye = plate("x", -13, 13, [(0, elbow, 24), (0, elbow + 46, 15)], 2)
    cables = [disc("z", elbow, 0, 0.9, (-30.5, y)) for y in (-28, 28)]
    return [
        *fused("casting", hub, pack, disc("z", -70, -20, 21, edge=4)),
        *made_of("aluminium", disc("z", elbow + 50, -50, 16)),
        *fused("casting", disc("z", elbow + 42, elbow + 76, 20, edge=4), eye),
        *made_of("cover", *(disc("x", low, low + 9, 29, (-15.5, 160.5), 2.5) for low in (-52.5, 43.5))),
        *made_of("steel", *(bolts("x", low, low + 1.2, 24, 6, 2, (-15.5, 160.5)) for low in (-53.4, 52.2))),
        *made_of("steel", cables, disc("x", -36, 28, 12)),
        *pulley(-34, 31),
    ]


def crank_link(lengths: Lengths) -> Body:
    """Returns the crank beside the upper arm, and the counterweight behind the shoulder: three bolted slabs."""
    centre = (152.0, -42.0)
    tilt = atan2(centre[1], centre[0])
    corners = []
    for along, sideways in ((-27, -27), (-27, 27), (27, 27), (27, -27)):
        y = centre[0] + along * cos(tilt) - sideways * sin(tilt)
        corners.append((y, centre[1] + along * sin(tilt) + sideways * cos(tilt), 11.0))
    slabs = [plate("x", low, low + 26, corners, 2.5) for low in (-40, -13, 14)]
    core = [(y, z, 8.0) for y, z, _ in corners]
    arm = plate("x", 28, 37, [(0, 0, 30), (-lengths.crank, 0, 12)], 2.5)
    tail = plate("x", 28, 37, [(0, 0, 30), (0.8 * centre[0], 0.8 * centre[1], 26)], 2.5)
    tip = (-lengths.crank, 0)
    return [
        *fused("casting", arm, tail),
        *made_of("cover", slabs, disc("x", 38, 48, 24, centre, 3)),
        *made_of("steel", plate("x", -39, 39, core), disc("x", 36, 49, 5, tip), disc("x", 47.5, 50, 8, tip, 0.8)),
        *made_of("steel", bolts("x", -42, -39, 27, 4, 4, centre, 0.4), bolts("x", 47, 49, 19, 6, 1.8, centre)),
    ]


def coupler_link(lengths: Lengths) -> Body:
    """Returns the bar of the parallelogram between two eyes."""
    foot = -lengths.upper_arm
    bar = plate("x", 40, 46, [(0, 0, 6.5), (0, foot, 6.5)], 1.5)
    eyes = [disc("x", 39, 47, 12, (0, z), 1.5) for z in (0, foot)]
    necks = [plate("x", 39.5, 46.5, [(0, z, 10), (0, z + sign * 34, 6.5)], 1.5) for z, sign in ((0, -1), (foot, 1))]
    return fused("aluminium", bar, *eyes, *necks)


def forearm_link(lengths: Lengths) -> Body:
    """Returns the fork at the elbow, the tube, the boss of the coupler pin, and the bearing of the platform."""
    end, pin = -lengths.forearm, -lengths.crank
    cheeks = [plate("x", low, low + 11, [(0, 0, 25), (-58, 0, 15)], 2) for low in (-25, 14)]
    return [
        *fused("casting", *cheeks, disc("y", -78, -48, 21.5, edge=5)),
        *made_of("aluminium", disc("y", end, -60, 14.5)),
        *fused("casting", disc("y", pin - 15, pin + 15, 18, edge=3), disc("x", 0, 38, 10, (pin, 0))),
        *fused("casting", disc("y", end, end + 52, 18, edge=4), disc("z", -25, 22, 24, (0, end), 4)),
        *made_of("cover", disc("z", -32, -24, 19, (0, end), 3), disc("z", 21, 24.5, 20, (0, end))),
        *made_of("cover", disc("x", 24, 28, 17, edge=1.5)),
        *made_of("steel", disc("x", 36, 49, 5, (pin, 0)), disc("x", 47.5, 50, 8, (pin, 0), 0.8)),
        *made_of("steel", bolts("z", -33, -31, 13, 4, 1.8, (0, end)), bolts("x", 27, 29, 12, 5, 1.7)),
        *pulley(-34, 31),
    ]


def arc(centre: cad.Vector, *points: tuple[float, float, float]) -> cad.Edge:
    """Returns a circular arc through three points that are given relative to `centre`."""
    return cad.ThreePointArc(*(centre + cad.Vector(*point) for point in points)).edge()


def platform_link(lengths: Lengths) -> Body:
    """Returns the hub at the end of the forearm, and the curved bracket from the hub up to the pitch axis."""
    rise, radius = lengths.rise, 114.0
    half = radius / 2**0.5
    wrist = cad.Vector(0, 0, rise)
    path = arc(wrist, (0, 0, -radius), (half, 0, -half), (radius, 0, 0))
    bracket = swept(path, (0, 0, -1), (32, 14, 5.5), (27, 13.5, 5.5), (23, 13, 5.5))
    return [
        *fused("casting", bracket, disc("z", 25, 45, 25, edge=4), disc("x", 106.5, 124, 20, (0, rise), 3.5)),
        *made_of("cover", disc("x", 123, 146, 13.5, (0, rise), 4)),
        *made_of("steel", disc("x", 96, 107, 8, (0, rise)), bolts("x", 123, 125, 15.4, 6, 1.2, (0, rise))),
        *made_of("steel", bolts("z", 44, 46, 17, 6, 1.8), disc("z", 44, 45.8, 9, edge=0.6)),
    ]


def wrist_pitch_link(_: Lengths) -> Body:
    """Returns the bracket from the pitch axis behind the hand down to the yaw axis, with the yaw motor."""
    radius = 87.0
    mid = (0.70, -0.58, -0.42)
    length = hypot(*mid)
    path = arc(cad.Vector(0, 0, 0), (radius, 0, 0), (*(radius * x / length for x in mid),), (0, 0, -radius))
    bracket = swept(path, (1, 0, 0), (19, 9.5, 4), (19, 9.5, 4))
    motor = (62.0, -52.0)
    return [
        *fused(
            "graphite",
            bracket,
            disc("x", 79, 98, 15, edge=2.5),
            disc("z", -100, -79, 14.5, edge=2.5),
            disc("z", -42, -26, 10.5, motor, 2.5),
        ),
        *made_of("anodised", disc("z", -40, 8, 8.5, motor, 1.5)),
        *made_of("steel", disc("z", -20, -17.5, 8.8, motor), disc("z", 5, 9.2, 3, motor, 0.8)),
        *made_of("steel", disc("x", 75, 80, 6), disc("z", -80, -72, 7)),
    ]


def wrist_yaw_link(_: Lengths) -> Body:
    """Returns the bracket from the yaw axis behind the hand up to the roll axis, with the roll motor."""
    radius = 62.0
    half = radius / 2**0.5
    path = arc(cad.Vector(0, 0, 0), (0, 0, -radius), (0, -half, -half), (0, -radius, 0))
    return [
        *fused(
            "casting",
            swept(path, (0, 0, -1), (17, 8, 3.5), (15, 8, 3.5)),
            disc("z", -72, -56, 11.5, edge=2),
            disc("y", -70, -52, 12.5, edge=2),
            disc("y", -50, -37, 8.5, (-47, 0), 2),
        ),
        *made_of("anodised", disc("y", -48, -16, 6.8, (-47, 0), 1)),
        *made_of("steel", disc("y", -53, -46, 6), disc("y", -34, -32, 7.1, (-47, 0))),
        *made_of("cover", disc("y", -70.6, -69, 9)),
    ]


def wrist_roll_link(_: Lengths) -> Body:
    """Returns the handle: stem along the roll axis, and two slightly open levers with springs, pads and straps."""
    profile = cad.Polyline((0, -47), (9, -47), (11, -45), (11.5, -36), (10.5, -30), (10.5, -20))
    nose = cad.Spline((10.5, -20), (7, -8), (4.5, 10), (0, 17), tangents=((0, 1), (-1, 0)))
    outline = [profile, nose, cad.Line((0, 17), (0, -47))]
    section = cad.make_face([edge for curve in outline for edge in curve.edges()])
    stem = cad.revolve(section, cad.Axis.Y)
    slots = [cad.Pos(side * 11, -18, 0) * cad.Box(10, 28, 13.5) for side in (-1, 1)]
    body = made_of("graphite", stem - slots)
    body += made_of("steel", disc("y", -49, -46, 7), [disc("z", -8.5, 8.5, 1.9, (x, -27)) for x in (-8, 8)])
    coil = cad.Rot(0, 90, 0) * cad.Torus(4.2, 0.6)
    body += made_of("steel", [cad.Pos(x, -1, 0) * coil for x in (-11, -9, -7, 7, 9, 11)])
    for side in (-1, 1):
        hinge = cad.Pos(side * 8, -27, 0) * cad.Rot(0, 0, -side * 14)
        neck = plate("x", -2, 2, [(0, 0, 5.5), (40, 0, 7)], 1.2)
        pad = plate("x", -2.2, 2.2, [(44, 0, 11), (62, 0, 10)], 1.8)
        faces = sorted((side * 1.5, side * 4.2))
        inlay = plate("x", *faces, [(44, 0, 9), (61, 0, 8.2)], 1.1)
        loop = [(-7, 0, 4.5), (7, 0, 4.5), (0, side * 11, 11)]
        strap = plate("y", 42, 58, loop) - plate("y", 41, 59, [(u, v, radius - 1.4) for u, v, radius in loop])
        parts = (*fused("casting", neck, pad), *made_of("rubber", inlay), *made_of("strap", strap))
        body += [(material, hinge * part) for material, part in parts]
    return body


LINKS: tuple[Callable[[Lengths], Body], ...] = (
    base_link,
    outer_yaw_link,
    upper_arm_link,
    forearm_link,
    platform_link,
    wrist_pitch_link,
    wrist_yaw_link,
    wrist_roll_link,
    crank_link,
    coupler_link,
)


def bodies(sdf: Path) -> dict[str, Callable[[], Body]]:
    """Returns the function that makes each link's body, by the link's name."""
    lengths = Lengths.read(sdf)
    return {link.__name__: partial(link, lengths) for link in LINKS}
