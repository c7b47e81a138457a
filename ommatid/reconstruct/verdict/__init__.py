"""Whether the results of a run can be trusted: the residual by part, the error's interval, and the variances."""
