"""Learning of the kernels of blurred lens types from the entries of H of a chart of sensor pixels."""
