"""The estimate of Eq. 4 with a certificate of its numerical error."""
