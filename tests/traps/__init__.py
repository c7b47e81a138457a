"""A folder of traps: modules, libraries, scripts and settings of which a command beside them must not use any."""
