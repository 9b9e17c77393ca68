"""Layouts of tables whose columns have no names, most of them of one research group.

`LAYOUTS` is the table of the known layouts. Readers of CSV files and of arrays use it to name the columns.
"""

from __future__ import annotations

from typing import NamedTuple

from dvrk_drake.models.arm import Arm
from dvrk_drake.models.arm_files import is_package_arm
from dvrk_drake.recordings.recording import FileCoordinates


class Layout(NamedTuple):
    """Columns of a table without names. Each quantity has one column per joint.

    Attributes:
        quantities: Quantities in the order of their columns.
        num_joints: Number of joints for which the layout is known; 0 for any number.
        gripper: Whether a column of the gripper, which is ignored, follows the joints of each quantity.
        rate: Sampling rate [Hz] of a motion; None for static poses.
        coordinates: Coordinates, if the layout states them.
        package_arms: Whether only arms of this package have such tables.
    """

    quantities: tuple[str, ...]
    num_joints: int = 0
    gripper: bool = False
    rate: float | None = None
    coordinates: FileCoordinates | None = None
    package_arms: bool = False

    def columns(self, n: int) -> list[str]:
        """Returns the names of the columns for n joints, e.g. "q1". A column that is ignored has the name ""."""
        joints = [*map(str, range(1, n + 1)), *[""] * self.gripper]
        return [joint and f"{quantity}{joint}" for quantity in self.quantities for joint in joints]


#: Static poses of WPI: array of 8 x 2 x N (https://github.com/WPI-AIM/dvrk_gravity_comp), as a table of 16 columns.
WPI_POSES = Layout(("q", "tau"), num_joints=7, gripper=True)
#: Known layouts, in the order in which they are tried.
LAYOUTS = (
    # Motions of WPI (https://github.com/WPI-AIM/dvrk_dynamics_identification).
    Layout(("q", "qd", "tau"), num_joints=7, rate=200.0, coordinates="wpi", package_arms=True),
    Layout(("q", "qd", "tau")),
    # Script `dvrk_ecm_psm_gc_collect.py` of the dVRK (https://github.com/jhu-dvrk/dvrk_python), for three joints.
    Layout(("q", "tau")),
    WPI_POSES,
)


def find_layout(width: int, arm: Arm | None, n: int) -> Layout | None:
    """Returns the layout of a table with `width` columns for n joints of an arm, or None if it has no known layout."""
    for layout in LAYOUTS:
        fits_arm = not layout.package_arms or arm is None or is_package_arm(arm)
        if fits_arm and layout.num_joints in (0, n) and width == len(layout.columns(n)):
            return layout
    return None
