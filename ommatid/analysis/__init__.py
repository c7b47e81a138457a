"""Predictions, designs, studies and summaries of a scene and of its results."""
