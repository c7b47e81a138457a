"""What the program says of a scene and of its results: predictions, designs, studies, summaries."""
