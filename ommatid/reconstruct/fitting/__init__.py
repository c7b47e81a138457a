"""Prior and noise of largest marginal likelihood."""
