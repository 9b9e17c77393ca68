"""Force and torque that an operator feels at the handle."""
