"""A simulated arm that its model does not describe exactly: what a real one is to its drawing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.framework import Context

from dvrk_drake.dynamics.actuator_effects import ActuatorEffect
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.effects_schema import ArmEffects, DriveEffect
from dvrk_drake.models.loop_closure import Closure
from dvrk_drake.models.plant import add_arm, set_joint_damping
from dvrk_drake.systems.arm_station import ArmStation


@dataclass(frozen=True)
class TrueArm:
    """A simulated arm that its model does not describe exactly.

    Attributes:
        arm: its description.
        inertias: link -> true spatial inertia about the link's origin.
        effects, coefficients: true effects in its drive [N m; N if prismatic].
        damping: (n,) viscous friction of the joints [N m s/rad; N s/m if prismatic].
        closure: how the loops of its linkage are held, see `add_arm`.
    """

    arm: Arm
    inertias: dict[str, SpatialInertia]
    effects: tuple[ActuatorEffect, ...]
    coefficients: tuple[float, ...]
    damping: NDArray[np.float64]
    closure: Closure

    def station(self, meshcat: Meshcat | None = None) -> ArmStation:
        """A station that simulates it, once `prepare` was called with a context."""
        terms = zip(self.effects, self.coefficients, strict=True)
        effects = ArmEffects(cables=[DriveEffect(e.coordinate, e.kind, e.scale, value) for e, value in terms])
        return ArmStation(self.arm, meshcat=meshcat, closure=self.closure, modify_plant=self._damp, effects=effects)

    def prepare(self, station: ArmStation, context: Context) -> None:
        """Puts the true inertias into a station's context."""
        station.SetLinkInertias(context, self.inertias)

    def _damp(self, plant: MultibodyPlant) -> None:
        set_joint_damping(plant, self.arm, self.damping)


def make_true_arm(
    arm: Arm,
    generator: np.random.Generator,
    effects: Sequence[ActuatorEffect] = (),
    coefficients: Sequence[float] = (),
    closure: Closure = "mimic",
) -> TrueArm:
    """An arm whose links are up to 20 % heavier or lighter than the model's, with springs and cables of its own."""
    plant = MultibodyPlant(1e-3)
    instance = add_arm(plant, arm)
    inertias = {}
    for index in plant.GetBodyIndices(instance):
        body = plant.get_body(index)
        M = body.default_spatial_inertia()
        if body.name() == "base_link":
            continue
        # Scaled mass, centre of mass moved by up to 2 mm: still a possible body, as the move adds what it must.
        shift = generator.uniform(-0.002, 0.002, 3)
        mass = M.get_mass() * generator.uniform(0.8, 1.2)
        I_Bcm = M.Shift(M.get_com()).get_unit_inertia()
        inertias[body.name()] = SpatialInertia(
            mass, M.get_com() + shift, UnitInertia(I_Bcm.ShiftFromCenterOfMass(-(M.get_com() + shift)))
        )
    return TrueArm(
        arm, inertias, tuple(effects), tuple(coefficients), arm.per_joint(0.03, 0.3) * arm.effort_limits, closure
    )
