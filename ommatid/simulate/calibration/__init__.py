"""H from rendered point sources or traced rays: entries, their uncertainty, and parametric fits."""
