"""The controller's end of the status channel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from dvrk_drake.lcmtypes import lcmt_dvrk_status
from dvrk_drake.models.arm import Arm


class DvrkStatusReceiver(LeafSystem):
    """What one arm measures, as ports, from the status of an LcmSubscriberSystem.

    .. pydrake_system::

        name: DvrkStatusReceiver
        input_ports:
        - lcmt_dvrk_status
        output_ports:
        - position_measured
        - velocity_estimated
        - state_estimated
        - effort_measured

    `state_estimated` has 2n numbers, q, then v, the others n, in the arm's order [rad, rad/s, N m; m, m/s, N on a
    prismatic joint]. Without a message of this arm, as before the first one, all are NaN: a pose that nobody measured
    is not zero.
    """

    def __init__(self, arm: Arm) -> None:
        """Of `arm`; messages of another arm or size count as none."""
        super().__init__()
        n = arm.num_joints
        self._arm_name, self._num_joints = arm.name, n
        self._status = self.DeclareAbstractInputPort("lcmt_dvrk_status", AbstractValue.Make(lcmt_dvrk_status()))
        for name, fields in {
            "position_measured": ("position",),
            "velocity_estimated": ("velocity",),
            "state_estimated": ("position", "velocity"),
            "effort_measured": ("effort_measured",),
        }.items():
            self.DeclareVectorOutputPort(name, n * len(fields), self._make_calc(fields))

    def _make_calc(self, fields: tuple[str, ...]) -> Callable[[Context, BasicVector], None]:
        def calc(context: Context, output: BasicVector) -> None:
            output.SetFromVector(np.concatenate([self._vector(context, field) for field in fields]))

        return calc

    def _vector(self, context: Context, field: str) -> NDArray[np.float64]:
        status = self._status.Eval(context)
        if status.arm_name != self._arm_name or status.num_joints != self._num_joints:
            return np.full(self._num_joints, np.nan)
        return np.array(getattr(status, field))
