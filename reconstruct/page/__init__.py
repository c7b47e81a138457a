"""One self-contained page of a run, and one of a batch: what a colleague is sent who was not there."""
