"""Ramp from the measured to the desired effort."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from dvrk_drake.errors import ControllerError
from dvrk_drake.systems.effort_ramp import EffortRamp

pytestmark = pytest.mark.drake_api


def test_ramp_starts_when_enabled_and_restarts():
    ramp = EffortRamp(2, duration=0.1)
    simulator = Simulator(ramp)
    context = simulator.get_mutable_context()
    measured, wanted = np.array([1.0, -1.0]), np.array([3.0, 5.0])
    ramp.GetInputPort("effort_measured").FixValue(context, measured)
    ramp.GetInputPort("effort_wanted").FixValue(context, wanted)
    enabled = ramp.GetInputPort("enabled")
    enabled.FixValue(context, [0.0])
    output = ramp.get_output_port()
    simulator.AdvanceTo(0.0505)
    np.testing.assert_array_equal(output.Eval(context), measured)
    enabled.FixValue(context, [1.0])
    simulator.AdvanceTo(0.1005)
    np.testing.assert_allclose(output.Eval(context), measured + 0.5 * (wanted - measured), atol=1e-9)
    # Later measurements have no effect.
    ramp.GetInputPort("effort_measured").FixValue(context, [7.0, 7.0])
    simulator.AdvanceTo(0.3005)
    np.testing.assert_allclose(output.Eval(context), wanted, atol=1e-9)
    enabled.FixValue(context, [0.0])
    simulator.AdvanceTo(0.3025)
    np.testing.assert_array_equal(output.Eval(context), [7.0, 7.0])


def test_a_forced_update_is_one_period():
    ramp = EffortRamp(1, period=0.01, duration=0.1)
    context = ramp.CreateDefaultContext()
    for name, value in {"effort_measured": [0.0], "effort_wanted": [1.0], "enabled": [1.0]}.items():
        ramp.GetInputPort(name).FixValue(context, value)
    for k in range(1, 15):
        state = ramp.AllocateDiscreteVariables()
        ramp.CalcForcedDiscreteVariableUpdate(context, state)
        context.SetDiscreteState(state)
        assert ramp.get_output_port().Eval(context)[0] == pytest.approx(min(1.0, 0.1 * k))


def test_invalid_ramp_is_refused():
    with pytest.raises(ControllerError, match="must be positive"):
        EffortRamp(7, duration=0.0)
