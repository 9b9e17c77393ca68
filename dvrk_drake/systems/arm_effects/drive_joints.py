"""Joints of a plant for the coordinates of the drive.

At these joints, Drake's solver computes the torques of friction and stops.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Joint,
    ModelInstanceIndex,
    RevoluteJoint,
    RigidBody,
    RotationalInertia,
    SpatialInertia,
)

from dvrk_drake.dynamics.actuator_effects import joint_row
from dvrk_drake.models.arm import Arm
from dvrk_drake.models.plant import make_arm_plant, set_arm_positions, tree_selector

#: Inertia of each added body, as a fraction of the arm's inertia along the coordinate. Mass of each added body [kg].
#: Drake limits the stiffness of a constraint. The limit depends on the lighter body and on the time step. At the
#: parallelogram of an MTM, an effort of 3 N m therefore causes a deflection of 1 mrad.
SHARE, MASS = 2e-3, 1e-6
#: Distance from the axis at which coupled bodies are constrained [m].
RADIUS = 0.1


class DriveJoints:
    """Finds or creates the joint for a coordinate of the drive, in a plant before Finalize.

    The coordinate is x = row @ q with a constant `row` (n,) and the joint positions q (n,). If x is proportional to the
    position of one joint, that joint is used. If x depends on several joints, a body with its own joint is added. The
    position of this joint is x. The body is coupled in one of two ways:

    - to a link that rotates by x about the same axis, e.g. the crank of the parallelogram relative to the yaw link,
    - otherwise to the last body of a chain that begins at the world. Each body of the chain rotates relative to the
      previous body by the contribution of one joint to x.
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, instance: ModelInstanceIndex) -> None:
        """Creates the object for the `arm` that `add_arm` added to `plant` as `instance`."""
        self._plant, self._arm, self._instance = plant, arm, instance
        self._added: list[tuple[Joint, NDArray[np.float64]]] = []

    def joint_of_coordinate(self, coordinate: str) -> tuple[Joint, float]:
        """Returns the joint of a named coordinate of the drive, and the factor from joint position to coordinate."""
        return self.joint(joint_row(self._arm, coordinate))

    def joint(self, row: NDArray[np.float64]) -> tuple[Joint, float]:
        """Returns the joint of x = row @ q, and the factor that converts the position of the joint to x."""
        terms = np.flatnonzero(np.abs(row) > 1e-12)
        if len(terms) == 1:
            (i,) = terms
            return self._plant.GetJointByName(self._arm.joint_names[i], self._instance), float(row[i])
        for joint, known in self._added:
            if np.allclose(known, row, atol=1e-12):
                return joint, 1.0
        joint = self._coaxial(row) or self._chain(row)
        self._added.append((joint, row))
        return joint, 1.0

    def set_positions(self, q_plant: NDArray[np.float64], q: ArrayLike) -> None:
        """Writes the positions of the added joints at the pose q (n,) into `q_plant` (nq,)."""
        q = np.asarray(q, float)
        for i, (joint, row) in enumerate(self._added):
            q_plant[joint.position_start()] = row @ q
            for k in np.flatnonzero(row):
                name = _chain_name(i, self._arm.joint_names[k])
                if self._plant.HasJointNamed(name, self._instance):
                    q_plant[self._plant.GetJointByName(name, self._instance).position_start()] = row[k] * q[k]

    def _coaxial(self, row: NDArray[np.float64]) -> Joint | None:
        """Returns a new joint for x = row @ q if x is the sum of the angles of coaxial joints, otherwise None."""
        plant, names = self._plant, self._arm.tree_joint_names
        above = {plant.GetJointByName(name, self._instance).child_body().index(): name for name in names}
        for name in names:
            last = joint = plant.GetJointByName(name, self._instance)
            total, along = np.zeros_like(row), np.zeros(3)
            while isinstance(joint, RevoluteJoint):
                sign = float(joint.revolute_axis() @ last.revolute_axis())
                if abs(abs(sign) - 1.0) > 1e-12:
                    break
                total = total + sign * self._arm.linkage.matrix[names.index(joint.name())]
                if np.allclose(total, row, atol=1e-12):
                    origin = _offset(joint.frame_on_parent()) + along
                    return self._add_coaxial_joint(row, joint.parent_body(), origin, last)
                parent = joint.parent_body()
                if parent.index() not in above:
                    break
                upper = plant.GetJointByName(above[parent.index()], self._instance)
                step = _offset(joint.frame_on_parent()) - _offset(upper.frame_on_child())
                if np.linalg.norm(np.cross(step, last.revolute_axis())) > 1e-9:
                    break
                along, joint = along + step, upper
        return None

    def _add_coaxial_joint(
        self,
        row: NDArray[np.float64],
        parent: RigidBody,
        p_PR: NDArray[np.float64],
        last: RevoluteJoint,
    ) -> Joint:
        """Adds a body and its joint about the axis of `last`. Returns the joint.

        Args:
            row: Row (n,) of the coordinate.
            parent: Parent body P of the joint.
            p_PR: Position (3,) of the joint in P [m].
            last: Last of the coaxial joints.
        """
        plant, name = self._plant, f"drive_{len(self._added)}"
        body = self._body(name, row)
        frame = plant.AddFrame(FixedOffsetFrame(f"{name}_base", parent, RigidTransform(p_PR)))
        joint = plant.AddJoint(RevoluteJoint(name, frame, body.body_frame(), last.revolute_axis()))
        self._couple_rotation(last.child_body(), _offset(last.frame_on_child()), body, last.revolute_axis())
        return joint

    def _chain(self, row: NDArray[np.float64]) -> Joint:
        plant, i = self._plant, len(self._added)
        axis, end = np.array([0.0, 0.0, 1.0]), plant.world_body()
        for k in np.flatnonzero(row):
            leader = self._arm.joint_names[k]
            body = self._body(_chain_name(i, leader), row)
            link = RevoluteJoint(_chain_name(i, leader), end.body_frame(), body.body_frame(), axis)
            follower = plant.AddJoint(link)
            plant.AddCouplerConstraint(follower, plant.GetJointByName(leader, self._instance), float(row[k]))
            end = body
        body = self._body(f"drive_{i}", row)
        joint = plant.AddJoint(RevoluteJoint(f"drive_{i}", plant.world_frame(), body.body_frame(), axis))
        self._couple_rotation(end, np.zeros(3), body, axis)
        return joint

    def _couple_rotation(
        self, A: RigidBody, p_AAxis: NDArray[np.float64], B: RigidBody, axis: NDArray[np.float64]
    ) -> None:
        """Couples the rotations of A and B about a common axis by a rigid rod between them.

        Seen along the axis, the ends of the rod on A and B are 90 degrees apart. Only the compliance of Drake's solver
        remains.
        """
        e = np.eye(3)[np.argmin(np.abs(axis))]
        f = np.cross(axis, e)
        p_AP, p_BQ = p_AAxis + RADIUS * e, RADIUS * f
        self._plant.AddDistanceConstraint(A, p_AP, B, p_BQ, float(np.sqrt(2.0)) * RADIUS)

    def _body(self, name: str, row: NDArray[np.float64]) -> RigidBody:
        about_axis = SHARE / float(row @ np.linalg.solve(_mass_matrix(self._arm), row))
        M_BBo_B = SpatialInertia.MakeFromCentralInertia(MASS, np.zeros(3), RotationalInertia(*np.full(3, about_axis)))
        return self._plant.AddRigidBody(name, self._instance, M_BBo_B)


@cache
def _mass_matrix(arm: Arm) -> NDArray[np.float64]:
    """Returns the mass matrix (n, n) with all joints in the middle of their ranges."""
    plant = make_arm_plant(arm)
    context = plant.CreateDefaultContext()
    set_arm_positions(plant, context, arm, 0.5 * (arm.position_lower + arm.position_upper))
    tree = tree_selector(plant, arm)
    M: NDArray[np.float64] = plant.CalcMassMatrix(context)[np.ix_(tree, tree)]
    G = arm.linkage.matrix
    return G.T @ M @ G


def _chain_name(i: int, leader: str) -> str:
    return f"drive_{i}_{leader}"


def _offset(frame: FixedOffsetFrame) -> NDArray[np.float64]:
    p: NDArray[np.float64] = frame.GetFixedPoseInBodyFrame().translation()
    return p
