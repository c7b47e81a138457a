"""Algebraic forms of the estimator (Eq. 4), one per module, all with the interface `form.Form`."""
