"""From light to recorded values."""
