"""H by few numbers: views of sharp lens types, kernels of blurred ones, and the errors of both."""
