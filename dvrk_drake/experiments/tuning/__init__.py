"""Tuning of `GravityPidController` for one arm, by the paper's procedure and from a model, with a comparison."""
