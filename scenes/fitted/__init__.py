"""H by few numbers: views, and what follows from them."""
