"""An arm's equations: symbolic gravity, base parameters, joint effects, identified models."""
