"""One simulation: the scenario that describes it, and its run."""
