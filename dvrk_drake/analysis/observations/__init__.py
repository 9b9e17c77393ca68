"""Signal processing of recordings: filtering, resampling, static segments, repetitions and folds."""
