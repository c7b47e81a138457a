"""The estimate of Eq. 4 with a certified bound on its numerical error."""
