"""Numerical stability of the estimator on stiff and extreme cases."""
