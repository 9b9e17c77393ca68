"""Shapes of the links of the PSM.

All numbers are millimetres in the base frame in the home pose. The origin of this frame is the remote centre of motion
(RCM), +Z is up, and the arm lies toward -Y. Each body is then moved into its link frame. The pivots are read from
psm.sdf. Links lie in parallel planes, symmetric about x = 0, so that they do not collide. The ranges of their parts
along x are:

    0 bars 13 | 15 front crank 20 | 22 back crank 30 | 32 counterweight 43 | 45 yaw fork 57 | motors
              | 15 end link 25    | 27 carriage 34

The end link is a channel that is open at the back, and the bars move between its flanges. Behind the back crank, the
yaw fork is empty up to 200 mm from the pivot of the crank. The back crank and the counterweight reach that far.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import build123d as cad
from home_positions import home_positions
from shapes import Body, bolts, both, disc, fused, made_of, moved, plate

Where = dict[str, tuple[float, float, float]]  # origins of links and frames in the home pose [mm]


def slab(side: float, low: float, high: float, circles: list[tuple[float, float, float]], edge: float = 0) -> cad.Part:
    """Returns a plate normal to x, between two distances from the plane x = 0 on one side."""
    return plate("x", *sorted((side * low, side * high)), circles, edge)


def stub(side: float, low: float, high: float, radius: float, at: tuple[float, float], edge: float = 0) -> cad.Part:
    """Returns a disc normal to x, between two distances from the plane x = 0 on one side."""
    return disc("x", *sorted((side * low, side * high)), radius, at, edge)


def yz(where: Where, name: str) -> tuple[float, float]:
    """Returns the coordinates (y, z) of a link or frame in the plane of the linkage."""
    return where[name][1], where[name][2]


def base_link(_: Where) -> Body:
    """Returns the fixed half of the round yaw housing, its motor, and the bar that is mounted on a setup joint."""
    bar = cad.fillet((cad.Pos(0, -824, 80) * cad.Box(64, 34, 300)).edges().filter_by(cad.Axis.Z), 8)
    square = [(x, y) for x in (-25.4, 25.4) for y in (-849.4, -798.6)]  # four holes of the real bar, 2 inches apart
    return [
        *fused("casting", disc("y", -788, -756, 76, edge=4), disc("y", -808, -780, 60, edge=3)),
        *made_of(
            "cover", disc("y", -757, -749, 70), disc("y", -882, -840, 33, edge=8), disc("y", -845, -838, 40, edge=2)
        ),
        *made_of("graphite", bar),
        *made_of("casting", plate("z", 228, 240, [(x, y, 10) for x in (-42, 42) for y in (-866, -782)], 3)),
        *made_of("steel", [disc("z", 218, 229, 4, hole) for hole in square], bolts("y", -843, -837, 36, 6, 2.2)),
        *made_of("aluminium", disc("z", 238, 330, 34, (0, -824))),
        *made_of("cover", disc("z", 239, 262, 39, (0, -824), 3)),
    ]


def yaw_link(where: Where) -> Body:
    """Returns the rotating half of the yaw housing, the fork that holds both cranks, and the motors on its sides."""
    rear, front = yz(where, "back_crank_link"), yz(where, "front_crank_link")

    def cheek(side: float) -> list[cad.Shape]:
        return [
            slab(side, 45, 57, [(-712, 30, 22), (-712, -30, 22), (-600, 0, 42), (*rear, 42)], 3),
            slab(side, 45, 57, [(*rear, 42), (*front, 28), (-325, -12, 26)], 3),
        ]

    def pack(side: float) -> cad.Shape:
        return slab(side, 55, 88, [(-700, 22, 24), (-700, -22, 24), (-622, 22, 24), (-622, -22, 24)], 7)

    def caps(side: float) -> list[cad.Shape]:
        return [
            stub(side, 56, 64, 33, rear, 3),
            stub(side, 56, 62, 19, front, 2),
            stub(side, 87, 92, 19, (-700, 0), 2),
            *(disc("y", -604, -566, 15, (z, side * 72), 3) for z in (20, -20)),
        ]

    def heads(side: float) -> list[cad.Shape]:
        return [
            *bolts("x", *sorted((side * 63, side * 65.5)), 26, 6, 2.2, rear),
            *bolts("x", *sorted((side * 61, side * 63.5)), 14, 5, 1.8, front),
            *(disc("y", -570, -563, 6, (z, side * 72), 1) for z in (20, -20)),
        ]

    cross = plate("x", -50, 50, [(-352, 2, 14), (-352, -30, 14), (-316, 0, 14), (-316, -30, 14)], 3)
    return [
        *fused("casting", *both(cheek), disc("y", -750, -722, 76, edge=4), cross),
        *made_of("casting", both(pack)),
        *made_of("cover", both(caps)),
        *made_of("steel", both(heads)),
    ]


def back_crank_link(where: Where) -> Body:
    """Returns two cheeks from the counterweight to the top bar, the web between them, and the counterweight's rails."""
    pivot, bottom, top = yz(where, "back_crank_link"), yz(where, "bottom_bar_link"), yz(where, "top_bar_link")
    track = where["counterweight_link"][1]
    tail = (track, -118.0)

    def cheek(side: float) -> cad.Shape:
        upper = slab(side, 22, 30, [(*pivot, 20), (*bottom, 14), (*top, 11)], 2)
        lower = slab(side, 22, 30, [(*pivot, 20), (*tail, 12), (track, -20, 12)], 2)
        return upper.fuse(lower)

    def rail(side: float) -> cad.Shape:
        return slab(side, 29, 32.5, [(track, -124, 4), (track, 172, 4)], 0.8)

    return [
        *fused("casting", *both(cheek), disc("x", -24, 24, 15, pivot), disc("x", -24, 24, 9, tail)),
        *made_of("steel", both(lambda side: stub(side, 29, 46, 13, pivot)), both(rail)),
        *made_of("steel", disc("x", -30, 30, 5, bottom), disc("x", -31.5, 31.5, 5, top)),
        *made_of(
            "cover", both(lambda side: stub(side, 20, 23, 9, bottom)), both(lambda side: stub(side, 20, 23, 9, top))
        ),
    ]


def front_crank_link(where: Where) -> Body:
    """Returns the two cheeks of the front crank."""
    pivot, tip = yz(where, "front_crank_link"), yz(where, "front_crank_tip")
    cheeks = both(lambda side: slab(side, 15, 20, [(*pivot, 13), (*tip, 9)], 1.2))
    return [
        *fused("aluminium", *cheeks, disc("x", -16, 16, 10, pivot)),
        *made_of("steel", disc("x", -46, 46, 7, pivot), disc("x", -21.3, 21.3, 5.5, tip, 0.8)),
    ]


def bar(start: tuple[float, float], end: tuple[float, float], half: float, radius: float) -> cad.Part:
    """Returns a straight bar between two pivots."""
    return plate("x", -half, half, [(*start, radius), (*end, radius)], 2)


def bottom_bar_link(where: Where) -> Body:
    """Returns the lower bar, which drives the end link and has the pin of the front crank."""
    start, end, pin = yz(where, "bottom_bar_link"), yz(where, "end_link"), yz(where, "front_crank_pivot")
    return [
        *fused("casting", bar(start, end, 13, 10)),
        *made_of("cover", both(lambda side: stub(side, 12, 14.2, 8.5, pin))),
        *made_of(
            "cover", both(lambda side: slab(side, 12.5, 13.6, [(pin[0] + 40, pin[1], 5), (end[0] - 60, end[1], 5)]))
        ),
        *made_of("steel", both(lambda side: stub(side, 12, 14.6, 7, end))),
    ]


def top_bar_link(where: Where) -> Body:
    """Returns the upper bar."""
    start, end = yz(where, "top_bar_link"), yz(where, "top_bar_tip")
    eyes = [disc("x", -12.5, 12.5, 7.6, at, 1) for at in (start, end)]
    return fused("aluminium", bar(start, end, 9, 6.8), *eyes)


def end_link(where: Where) -> Body:
    """Returns the insertion rail, a channel open at the back with the pins of both bars, and the cannula at the RCM."""
    bottom, top = yz(where, "end_link"), yz(where, "top_bar_pivot")

    def flange(side: float) -> cad.Shape:
        lower = slab(side, 15, 25, [(*bottom, 14), (*top, 14), (-34, 112, 10), (-32, 236, 10)], 2)
        return lower.fuse(slab(side, 15, 25, [(-34, 220, 10), (-30, 470, 9)], 2))

    web = plate("x", -25, 25, [(-25, 108, 6), (-25, 482, 6)], 2)
    foot = plate("x", -14, 14, [(-26, 118, 8), (-26, 68, 8)], 3)
    holder = plate("z", 58, 74, [(0, 0, 15), (0, -25, 12)], 2) - disc("z", 50, 80, 5)
    guides = both(lambda side: slab(side, 19, 27, [(-25, 142, 3.5), (-25, 470, 3.5)], 0.8))
    hats = both(lambda side: [stub(side, 24, 26.6, 10, bottom, 1), stub(side, 24, 26.6, 8, top, 1)])
    tube = disc("z", -34, 62, 5.8) - disc("z", -36, 64, 4.9)
    bowl = plate("z", 58, 92, [(0, 0, 12.5)], 2) - disc("z", 66, 94, 10.5) - disc("z", 50, 70, 4.9)
    return [
        *fused("casting", web, *both(flange), foot, holder),
        *made_of("steel", guides, disc("x", -26, 26, 5, bottom), disc("x", -26, 26, 4.5, top), tube, bowl),
        *made_of("cover", hats, disc("z", -4, 4, 6.3) - disc("z", -6, 6, 5.7)),
        *made_of(
            "cover",
            plate("x", -27, 27, [(-25, 484, 9), (-33, 484, 9)], 3),
            disc("z", 73.5, 77, 13.5) - disc("z", 70, 80, 12),
        ),
    ]


def insertion_link(_: Where) -> Body:
    """Returns the carriage on the rail, with the sterile adapter that holds an instrument and drives its four discs."""
    shoes = both(lambda side: slab(side, 27.6, 34, [(-27, 402, 7), (-20, 402, 7), (-27, 470, 7), (-20, 470, 7)], 2))
    back = cad.Pos(0, -15.5, 436) * cad.Box(62, 5, 82)
    discs = [disc("y", -10, -7.6, 8, (z, x)) for z in (424, 446) for x in (-12, 12)]
    screws = both(lambda side: [stub(side, 33, 35, 2, (y, z)) for y in (-29, -18) for z in (400, 472)])
    adapter = plate("y", -13.2, -9, [(z, x, 5) for z in (404, 468) for x in (-23, 23)])
    return [
        *fused("casting", *shoes, back),
        *made_of("graphite", adapter),
        *made_of("steel", discs, screws),
    ]


def counterweight_link(where: Where) -> Body:
    """Returns the counterweight, whose two slabs slide on the rails of the back crank."""
    y, z = yz(where, "counterweight_link")
    slab_corners = [(y + dy, z + dz, 5.0) for dy in (-31, 15) for dz in (-25, 25)]
    back = [(y + dy, z + dz, 5.0) for dy in (-31, -30) for dz in (-25, 25)]
    return [
        *fused("graphite", *both(lambda side: slab(side, 32.2, 42, slab_corners, 1.5)), plate("x", -34, 34, back)),
        *made_of("steel", both(lambda side: bolts("x", *sorted((side * 41, side * 43)), 17, 4, 2.2, (y - 6, z)))),
    ]


LINKS: tuple[Callable[[Where], Body], ...] = (
    base_link,
    yaw_link,
    back_crank_link,
    bottom_bar_link,
    top_bar_link,
    front_crank_link,
    end_link,
    insertion_link,
    counterweight_link,
)


def body_of(link: Callable[[Where], Body], where: Where) -> Body:
    """Returns the body of a link in its link frame."""
    return moved(link(where), [-x for x in where[link.__name__]])


def bodies(sdf: Path) -> dict[str, Callable[[], Body]]:
    """Returns the function that makes each link's body, by the link's name."""
    where = home_positions(sdf)
    return {link.__name__: partial(body_of, link, where) for link in LINKS}
