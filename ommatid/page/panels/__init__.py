"""The parts of a page: pictures with their data, charts, and sentences about them."""
