"""Signals of a recording: filtered, resampled, cut into rests, repetitions and folds."""
