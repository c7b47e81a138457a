"""The ways to compute Eq. 4, one a module, all of the same interface: `form.Form`."""
