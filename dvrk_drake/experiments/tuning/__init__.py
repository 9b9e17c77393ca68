"""Gains of `GravityPidController` for one arm: found by the paper's procedure and from a model, and compared."""
