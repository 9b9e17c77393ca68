"""Estimates the external joint efforts of an arm and the force at a point of contact while the arm moves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem, ValueProducer

from dvrk_drake.dynamics.identified_model import IdentifiedModel
from dvrk_drake.dynamics.kinematics import Contact, is_measurable
from dvrk_drake.dynamics.momentum_observer import BANDWIDTH, MomentumObserver
from dvrk_drake.errors import ArmError, ControllerError
from dvrk_drake.models.arm_schema import IMPLAUSIBLE


class ExternalForceEstimator(LeafSystem):
    """Estimates the force that acts on an arm at a point, with its covariance.

    .. pydrake_system::

        name: ExternalForceEstimator
        input_ports:
        - state_estimated
        - effort_measured
        output_ports:
        - external_effort
        - effort_covariance
        - force
        - force_covariance
        - measurable
        - contact
        - fault

    Ports, for n joints in the arm's order and k components of the force (see `Contact`) [rad, rad/s, N m; m, m/s, N on
    a prismatic joint]:

    - `state_estimated` (2n): q, then v.
    - `effort_measured` (n): measured efforts of the motors, all of them, at the joints.
    - `external_effort` (n): joint efforts that act on the arm from outside, see `MomentumObserver`.
    - `effort_covariance` (n^2): their covariance, row by row.
    - `force` (k): force on the arm at the point of contact [N]. It assumes that nothing else touches the arm.
    - `force_covariance` (k^2): its covariance, row by row [N^2].
    - `measurable` (k): 1 for each component that the arm can measure at its pose, else 0. Do not use the others.
    - `contact` (1): 1 while the external effort is significant, i.e. larger than the errors of the model at the stated
      rate of false alarms, else 0. It detects a contact at any point of the arm. The errors always include the assumed
      change between days. Without it, a simulated PSM had 11 false alarms in one minute at a stated rate of 1 per hour.
    - `fault` (1): 1 while an input is not finite or implausibly large, else 0.

    **Delay.** The estimate is a first-order low-pass of the force with the bandwidth w, so it is late by about 1 / w.

    **Covariance.** It contains the errors of the model on held-out motions, which include those of the estimated
    parameters, and the assumed change between days. While a joint is at rest, dry friction can balance a force. The
    covariance then contains the dry friction, so the interval of a force on an arm at rest is wide.

    **Fault.** During a fault, the outputs are 0, and nothing is measurable. Afterwards, the estimate starts from 0.

    **Time.** The state is updated every `period` seconds, at initialization and by a forced update. The forces are
    computed when an output is evaluated.

    Example:
        >>> import dvrk_drake as dvrk
        >>> files = {file.name: file for file in dvrk.write_samples("samples")}
        >>> arm = dvrk.load_arm("psm")
        >>> model = dvrk.identify(dvrk.read_recording(files["psm_motion.csv"], arm), arm).model
        >>> estimator = dvrk.ExternalForceEstimator(model)
        >>> estimator.GetOutputPort("force").size()
        3
    """

    def __init__(
        self,
        model: IdentifiedModel,
        *,
        contact: Contact | None = None,
        bandwidth: float = BANDWIDTH,
        same_day: bool = False,
        false_alarms_per_hour: float = 1.0,
        period: float = 1e-3,
    ) -> None:
        """Creates the estimator for the model's arm.

        Args:
            model: Model that was identified from a motion.
            contact: Point at which the force acts. None: the origin of the frame `arm.frames.hand`.
            bandwidth: Bandwidth w of the observer [rad/s].
            same_day: True if the model was identified on the same day. By default, the covariance contains the assumed
                change of the efforts between days.
            false_alarms_per_hour: Expected rate of false alarms of the output `contact`, see
                `MomentumObserver.threshold`.
            period: Period of the update [s].

        Raises:
            ModelError: The model has no dynamics, or does not state its errors.
            ArmError: The arm has locked joints, or `contact` belongs to another arm.
            ControllerError: Bandwidth, period or rate of false alarms is out of range.
        """
        super().__init__()
        arm = model.arm
        arm.refuse_locked_joints("an estimator")
        self._contact = contact or Contact(arm)
        if self._contact.num_joints != arm.num_joints:
            raise ArmError(f"contact has {self._contact.num_joints} joints; allowed: {arm.num_joints}")
        self._observer = MomentumObserver(model, bandwidth=bandwidth, period=period)
        self._observer.covariance(self._observer.start(), other_day=not same_day)
        self._threshold = self._observer.threshold(false_alarms_per_hour)
        self._other_day = not same_day
        n, k = arm.num_joints, len(self._contact.components)
        self._n, self._k = n, k
        self._state_port = self.DeclareVectorInputPort("state_estimated", 2 * n)
        self._effort_port = self.DeclareVectorInputPort("effort_measured", n)
        # State of the observer, then 1 if it is valid.
        self._memory = self.DeclareDiscreteState(self._observer.size + 1)
        ticket = {self.discrete_state_ticket(self._memory)}
        allocate = ValueProducer(lambda: AbstractValue.Make((np.zeros(k),) * 3), self._calc_force)
        self._of_contact = self.DeclareCacheEntry("force and covariance", allocate, ticket)
        self.DeclareVectorOutputPort("external_effort", n, self._calc_effort, ticket)
        self.DeclareVectorOutputPort("effort_covariance", n * n, self._calc_effort_covariance, ticket)
        for i, (name, size) in enumerate((("force", k), ("force_covariance", k * k), ("measurable", k))):
            self.DeclareVectorOutputPort(name, size, self._make_calc(i), {self._of_contact.ticket()})
        self.DeclareVectorOutputPort("contact", 1, self._calc_contact, ticket)
        self.DeclareVectorOutputPort("fault", 1, self._calc_fault, ticket)
        self.DeclareInitializationDiscreteUpdateEvent(self._restart)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareForcedDiscreteUpdateEvent(self._update)

    def _restart(self, context: Context, state: DiscreteValues) -> None:
        state.get_mutable_value(int(self._memory))[-1] = 0.0
        self._update(context, state)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        memory = state.get_mutable_value(int(self._memory))
        for port in (self._state_port, self._effort_port):
            if not port.HasValue(context):
                raise ControllerError(f"input port {port.get_name()} is not connected")
        measured, tau = self._state_port.Eval(context), self._effort_port.Eval(context)
        was_valid = memory[-1] == 1.0
        memory[-1] = 0.0
        if not (np.all(np.abs(measured) < IMPLAUSIBLE) and np.all(np.abs(tau) < IMPLAUSIBLE)):  # also true for NaN
            return
        if not was_valid:
            memory[:-1] = self._observer.start()
        self._observer.update(memory[:-1], measured[: self._n], measured[self._n :], tau)
        memory[-1] = 1.0

    def _effort(self, context: Context) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None:
        """Returns the pose (n,), and the external effort (n,) with its covariance (n, n). Returns None in a fault."""
        memory = context.get_discrete_state(int(self._memory)).get_value()
        if memory[-1] == 0.0:
            return None
        state, observer = memory[:-1], self._observer
        return observer.pose(state), observer.effort(state), observer.covariance(state, other_day=self._other_day)

    def _calc_effort(self, context: Context, output: BasicVector) -> None:
        estimate = self._effort(context)
        output.SetFromVector(np.zeros(self._n) if estimate is None else estimate[1])

    def _calc_effort_covariance(self, context: Context, output: BasicVector) -> None:
        estimate = self._effort(context)
        output.SetFromVector(np.zeros(self._n**2) if estimate is None else estimate[2].ravel())

    def _calc_force(self, context: Context, value: AbstractValue) -> None:
        """Computes the force (k,), its covariance (k, k), and 1 or 0 for each component that is measurable (k,)."""
        estimate = self._effort(context)
        if estimate is None:
            value.set_value((np.zeros(self._k), np.zeros((self._k, self._k)), np.zeros(self._k)))
            return
        force, covariance = (x[0] for x in self._contact.force(*(x[None] for x in estimate)))
        value.set_value((force, covariance, is_measurable(covariance).astype(float)))

    def _calc_contact(self, context: Context, output: BasicVector) -> None:
        memory = context.get_discrete_state(int(self._memory)).get_value()
        is_valid = memory[-1] == 1.0
        found = is_valid and self._observer.significance(memory[:-1]) > self._threshold
        output.SetAtIndex(0, float(found))

    def _make_calc(self, part: int) -> Callable[[Context, BasicVector], None]:
        """Returns the function that outputs one part of the cached force at the contact."""
        return lambda context, output: output.SetFromVector(self._of_contact.Eval(context)[part].ravel())

    def _calc_fault(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._effort(context) is None))
