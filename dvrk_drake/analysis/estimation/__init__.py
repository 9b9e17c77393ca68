"""The estimator of all fits: normal equations, priors, signs, weights, and errors of held-out groups of rows."""
