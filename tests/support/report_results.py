"""Small results of simulations for tests of reports. The numbers are made up, so that no simulation runs."""

import numpy as np

import dvrk_drake as dvrk
from dvrk_drake.experiments.study import RandomPoses, Study, Variation
from dvrk_drake.experiments.study_measures import Measure
from dvrk_drake.experiments.study_run import Row
from dvrk_drake.experiments.transparency import OperatorForces
from dvrk_drake.experiments.tuning import CONDITIONS, OWN, PUBLISHED, Comparison, Tuning
from dvrk_drake.experiments.tuning_bench import Response, step_size
from dvrk_drake.experiments.tuning_model_based import ArmDesign, JointDesign, JointProperties, Margins
from dvrk_drake.experiments.tuning_procedure import JointProcedure, Ultimate


def study_results():
    """Returns a study of an MTML with one failed run, and its rows."""
    study = Study(
        scenario="mtml",
        random_poses=RandomPoses(6, seed=3),
        seeds=[1, 2],
        variations=[Variation("exact"), Variation("another one", ["controller.parameter_error=0.2"])],
        measures=[Measure("held"), Measure("drift"), Measure("effort_share")],
    )
    rows = {c.index: Row({"held": c.index % 3 > 0, "drift": 1e-3 * c.index, "effort_share": 0.1}) for c in study.cases}
    rows[5] = Row({}, "RuntimeError: the solver failed")
    return study, rows


def tuning_result():
    """Returns a tuning of a PSM. The gains of method "model" are the best."""
    arm = dvrk.load_arm("psm")
    names = (OWN, PUBLISHED, "paper", "model")
    settling = {name: k for k, name in enumerate(reversed(names))}
    n, q = arm.num_joints, arm.sample_poses(6, np.random.default_rng(0))
    shape = (len(CONDITIONS), len(q), n)
    times = {name: np.broadcast_to(np.where(np.arange(n) < settling[name], np.inf, 0.5), shape) for name in names}
    responses = {name: _response(arm, q[0], 3.0 + k) for k, name in enumerate(names)}
    comparison = Comparison(arm, dict.fromkeys(names, arm.gains), CONDITIONS, q, times, responses)
    procedure = JointProcedure(1.2, 0.3, 0.5, Ultimate(1234.5, 0.123, 1.01, False), 1.0, False, 1.234e-3)
    properties = JointProperties((1.23e-4, 4.56e-3), 0.1, 0.1, 1.0, 1e-4, 1e-3, 3.0)
    design = JointDesign(1.2, 0.3, 0.5, 123.4, (Margins(0.7, 100.0, 2.3),) * 2, "phase margin")
    return Tuning(arm, (procedure,) * n, ArmDesign(arm.gains, (properties,) * n, (design,) * n), comparison)


def _response(arm, q, rate):
    """Returns an exponential step response with a rate [1/s]."""
    t = np.linspace(0.0, 2.0, 201)
    share = 1.0 - np.exp(-rate * t)[:, None]
    positions = q + share * step_size(arm)
    return Response(t, positions, positions, (1 - share) * arm.effort_limits, q + step_size(arm))


def operator_forces():
    """Returns an arm, and the interaction forces with three compensations. The last has the smallest forces."""
    t = np.linspace(0.0, 12.0, 100)
    vectors = np.random.default_rng(0).normal(size=(100, 3))
    names = ("nothing", "model A", "model A, friction 0.5")
    off = np.abs(vectors[:, 0]) / 100
    forces = [OperatorForces(name, t, vectors / 10, (4 - k) * vectors, off) for k, name in enumerate(names)]
    return dvrk.load_arm("mtml"), forces
