"""The stages of a run in their order, and how a given time is divided among them."""
