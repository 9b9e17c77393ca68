"""Another day, the same arm: what drifts is identified anew from a short motion."""
